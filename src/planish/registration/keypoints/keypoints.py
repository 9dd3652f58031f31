"""Keypoints: places with a metric size, an orientation and a normal, each a full local frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array


@dataclass(frozen=True)
class Keypoints:
    """N places on a measurement's surface.

    Parameters
    ----------
    points_sensor : ndarray (N, 3)
        Position [mm].
    frames_sensor : ndarray (N, 3, 3)
        Columns: orientation of the texture in the tangent plane, normal x orientation, normal.
    size_mm : ndarray (N,)
        Diameter of the blob: twice the scale at which it was found. What is described is ten times as wide [mm].
    pixels : ndarray (N, 2)
        Pixel (u, v) of the organising camera.
    descriptors : ndarray (N, 128) uint8
        What the neighbourhood looks like in the frame. Whole numbers: their dot products are exact in any order.
    chart : ndarray (N,) intp
        Index of the texture image that the keypoint was found in.
    chart_px : ndarray (N, 2)
        Position (column, row) in it [texture px].
    chart_angle_rad : ndarray (N,)
        Direction of the orientation in it, from its x axis towards y.
    """

    points_sensor: Array = field(metadata={"unit": "mm"})
    frames_sensor: Array
    size_mm: Array = field(metadata={"unit": "mm"})
    pixels: Array = field(metadata={"unit": "px"})
    descriptors: NDArray[np.uint8]
    chart: NDArray[np.intp]
    chart_px: Array = field(metadata={"unit": "texture px"})
    chart_angle_rad: Array = field(metadata={"unit": "rad"})

    def __len__(self) -> int:
        return len(self.points_sensor)

    def take(self, index: NDArray[Any]) -> Keypoints:
        """Return the keypoints at `index` (indices or mask)."""
        return Keypoints(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def no_keypoints() -> Keypoints:
    """Return the keypoints of a measurement without texture."""
    none, points = np.empty(0), np.empty((0, 3))
    return Keypoints(
        points, np.empty((0, 3, 3)), none, np.empty((0, 2)), np.empty((0, 128), np.uint8), np.empty(0, np.intp),
        np.empty((0, 2)), none,
    )  # fmt: skip
