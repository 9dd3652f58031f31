"""Detection and description of keypoints on the texture images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.options import Options
from planish.registration.keypoints.keypoints import Keypoints, no_keypoints
from planish.registration.texture.resample import TextureImage


class KeypointOptions(Options):
    """Options of keypoint detection and description (SIFT, Lowe 2004, on the metric texture image)."""

    #: Largest number of keypoints per measurement.
    max_keypoints: int = Field(default=4000, ge=10)
    #: SIFT's threshold on the difference of Gaussians, on a texture whose robust deviation is `grey_per_deviation`.
    contrast_threshold: float = Field(default=0.02, gt=0)
    #: SIFT's limit on the ratio of principal curvatures.
    edge_threshold: float = Field(default=10.0, gt=1)
    #: Grey levels (of 255) that one robust standard deviation of the texture is spread to.
    grey_per_deviation: float = Field(default=22.0, gt=0)


def detect_keypoints(images: tuple[TextureImage, ...], options: KeypointOptions | None = None) -> Keypoints:
    """Return the strongest keypoints of a measurement's texture images, in a fixed order."""
    options = options or KeypointOptions()
    share = max(10, options.max_keypoints // max(1, len(images)))
    parts = [_detect(image, i, options, share) for i, image in enumerate(images)]
    if not parts:
        return no_keypoints()
    return Keypoints(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in Keypoints.__dataclass_fields__)
    )


def to_grey(image: TextureImage, grey_per_deviation: float) -> NDArray[np.uint8]:
    """Return the texture as an 8 bit picture (h, w): mid grey outside the mask, robustly stretched."""
    inside = image.value[image.mask]
    # 1.4826 median |x|: the standard deviation of normally distributed values, untouched by scratches and specks.
    deviation = 1.4826 * float(np.median(np.abs(inside))) if inside.size else 1.0
    grey = 128 + image.value * (grey_per_deviation / max(deviation, 1e-9))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _detect(image: TextureImage, chart: int, options: KeypointOptions, count: int) -> Keypoints:
    # Precise upscaling: without it every position is off by a constant quarter of a pixel, which a half turn doubles.
    sift = cv2.SIFT.create(
        nfeatures=count,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        enable_precise_upscale=True,
    )
    grey = to_grey(image, options.grey_per_deviation)
    found, descriptors = sift.detectAndCompute(grey, image.mask.astype(np.uint8) * 255)
    if not found:
        descriptors = np.empty((0, 128), np.float32)
    xy = np.array([k.pt for k in found], float).reshape(-1, 2)
    size = np.array([k.size for k in found]) * image.pitch_mm
    angle = np.deg2rad([k.angle for k in found])
    # A keypoint whose place cannot be interpolated stands at the rim of the surface.
    points, frames, pixels = image.locate(xy, angle)
    inside: NDArray[np.bool_] = np.isfinite(points[:, 0])
    # Strongest first; position breaks ties, so that the order does not depend on the detector's threads.
    response = np.array([k.response for k in found])
    order = np.lexsort((angle, xy[:, 0], xy[:, 1], -response))
    order = order[inside[order]][:count]
    return Keypoints(
        points[order],
        frames[order],
        size[order],
        pixels[order],
        np.rint(descriptors[order]).astype(np.uint8),
        np.full(len(order), chart, np.intp),
        xy[order],
        angle[order],
    )
