"""Detection and description of keypoints on the texture images.

The scale of the texture is metric, so that nothing is searched over scales: blobs are found at few fixed ones, where
they stand out of the known noise, and what is described is a wide neighbourhood, smoothed as much as the blobs are.
Where texture is weak, the width of what is compared and not its detail decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from planish.geometry import Array
from planish.options import Options
from planish.registration.keypoints.blobs import SmoothTexture, find_blobs, smooth_texture, spread_evenly
from planish.registration.keypoints.describe import describe
from planish.registration.keypoints.frames import SurfacePlaces, places_on_surface
from planish.registration.keypoints.keypoints import Keypoints, no_keypoints
from planish.registration.keypoints.orient import orient
from planish.registration.texture.resample import TextureImage


class KeypointOptions(Options):
    """Options of keypoint detection and description.

    Lengths are in pixels of the texture images, whose pitch is one for a run and follows the resolution of its data.
    """

    #: Largest number of keypoints per measurement, shared by its charts and scales.
    max_keypoints: int = Field(default=5000, ge=10)
    #: Standard deviations of the smoothing at which blobs are found and described [texture px].
    scales_px: tuple[float, ...] = Field(default=(2.0, 4.0), min_length=1)
    #: Blobs that stand out by less than this many standard deviations of the noise are none.
    min_significance: float = Field(default=2.5, ge=0)
    #: Edge of the cells over which keypoints are spread, in multiples of the scale.
    cell_scales: float = Field(default=20.0, gt=0)
    #: Directions of the gradient are averaged over this multiple of the scale (standard deviation).
    orientation_scales: float = Field(default=3.0, gt=0)
    #: A second direction at least this strong, relative to the strongest, makes a second keypoint if there is room.
    second_orientation: float = Field(default=0.85, gt=0, le=1)
    #: Radius of the described neighbourhood, in multiples of the scale.
    support_scales: float = Field(default=10.0, gt=0)


@dataclass(frozen=True)
class _Candidates:
    """Blobs of one scale in one chart with their orientations; `which` says whose second ones `second_angle` are."""

    image: TextureImage
    chart: int
    texture: SmoothTexture
    xy: Array
    angle: Array
    which: NDArray[np.intp]
    second_angle: Array

    def keypoints(self, seconds: int, support_scales: float) -> Keypoints:
        """Return the keypoints of all blobs, and so many more of second orientations."""
        xy = np.concatenate([self.xy, self.xy[self.which[:seconds]]])
        angle = np.concatenate([self.angle, self.second_angle[:seconds]])
        places = places_on_surface(self.image, xy, angle)
        words = describe(self.texture, places.xy, places.angle, support_scales)
        size_mm = np.full(len(places), 2 * self.texture.scale_px * self.image.pitch_mm)
        return keypoints_at(self.chart, places, size_mm, words)


def detect_keypoints(images: tuple[TextureImage, ...], options: KeypointOptions | None = None) -> Keypoints:
    """Return the keypoints of a measurement's texture images, by chart and scale, the surest first."""
    options = options or KeypointOptions()
    area = sum(int(image.mask.sum()) for image in images)
    candidates, left = [], 0.0
    for chart, image in enumerate(images):
        if not image.mask.any():
            continue
        # Every scale and every part of the surface gets its share: which texture is good for what is not known before.
        share = options.max_keypoints * float(image.mask.sum()) / area / len(options.scales_px)
        # Coarse blobs are few: what they leave goes to the next scale.
        for scale in sorted(options.scales_px, reverse=True):
            candidates.append(_candidates(image, chart, scale, options, int(share + left)))
            left += share - len(candidates[-1].xy)
    parts, spare = [], options.max_keypoints - sum(len(c.xy) for c in candidates)
    for i, c in enumerate(candidates):
        # Second orientations take what blobs have left.
        seconds = min(len(c.which), spare // (len(candidates) - i))
        spare -= seconds
        parts.append(c.keypoints(seconds, options.support_scales))
    if not parts:
        return no_keypoints()
    found = Keypoints(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in Keypoints.__dataclass_fields__)
    )
    return found if len(images) == 1 else found.take(~_twins(found))


def _twins(keypoints: Keypoints) -> NDArray[np.bool_]:
    """Which keypoints (N,) an earlier chart has, too: the same scale, no farther than the scale.

    Charts may overlap, and a place described in two of them would be its own second nearest neighbour in every match.
    """
    twins = np.zeros(len(keypoints), bool)
    for chart in np.unique(keypoints.chart)[1:]:
        for size in np.unique(keypoints.size_mm):
            same = keypoints.size_mm == size
            earlier, own = (np.flatnonzero(same & c) for c in (keypoints.chart < chart, keypoints.chart == chart))
            distance, _ = cKDTree(keypoints.points_sensor[earlier]).query(keypoints.points_sensor[own])
            twins[own] = distance < size / 2
    return twins


def _candidates(image: TextureImage, chart: int, scale_px: float, options: KeypointOptions, count: int) -> _Candidates:
    texture = smooth_texture(image, scale_px)
    blobs = find_blobs(texture, options.min_significance)
    xy = blobs.xy[spread_evenly(blobs, options.cell_scales * scale_px)[:count]]
    angle, which, second = orient(texture, xy, options.orientation_scales, options.second_orientation)
    return _Candidates(image, chart, texture, xy, angle, which, second)


def keypoints_at(chart: int, places: SurfacePlaces, size_mm: Array, descriptors: NDArray[np.uint8]) -> Keypoints:
    """Return keypoints at places of the texture image number `chart`."""
    return Keypoints(
        places.points_sensor, places.frames_sensor, size_mm, places.source_px, descriptors,
        np.full(len(places), chart, np.intp), places.xy, places.angle,
    )  # fmt: skip
