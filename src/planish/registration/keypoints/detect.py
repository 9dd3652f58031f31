"""Detection and description of keypoints on the texture images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.geometry import Array, invert, transform_points
from planish.measurement import Map
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
    column, row = np.rint(xy).astype(int).T.reshape(2, -1)
    # A keypoint whose position cannot be interpolated stands at the rim of the surface.
    place = np.hstack([_sample(image.height_mm, xy), _sample(image.source_px, xy)])
    inside = image.mask[row, column] & np.isfinite(place).all(1)
    # Strongest first; position breaks ties, so that the order does not depend on the detector's threads.
    response = np.array([k.response for k in found])
    order = np.lexsort((angle, xy[:, 0], xy[:, 1], -response))
    order = order[inside[order]][:count]
    xy, size, angle, place = xy[order], size[order], angle[order], place[order]
    column, row = column[order], row[order]

    points_chart = np.column_stack([xy * image.pitch_mm, place[:, 0]])
    normal = image.normal_chart[row, column].astype(float)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    # The orientation is measured in the chart's plane; its tangent is what projects onto it along the chart's axis.
    direction[:, 2] = -(direction[:, 0] * normal[:, 0] + direction[:, 1] * normal[:, 1]) / normal[:, 2]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    frames = np.stack([direction, np.cross(normal, direction), normal], axis=2)
    T_sensor_chart = invert(image.T_chart_sensor)
    return Keypoints(
        np.asarray(transform_points(T_sensor_chart, points_chart), float),
        T_sensor_chart[:3, :3] @ frames,
        size,
        place[:, 1:],
        np.rint(descriptors[order]).astype(np.uint8),
        np.full(len(order), chart, np.intp),
        xy,
        angle,
    )


def _sample(image: Map, xy: Array) -> Array:
    """Values (N, C) of an image (h, w) or (h, w, C) at places (N, 2), linearly interpolated."""
    if len(xy) == 0:
        return np.empty((0, 1 if image.ndim == 2 else image.shape[2]))
    at = xy.astype(np.float32)
    values = cv2.remap(image, at[:, :1], at[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(len(xy), -1).astype(float)
