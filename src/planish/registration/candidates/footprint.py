"""The surface of a measurement in a thousand points: enough to see which ones overlap where they are placed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Measurement

#: Blocks of pixels along the longer side of the image.
_BLOCKS = 48


@dataclass(frozen=True)
class Footprint:
    """N points of a measurement's surface, spread evenly over its image.

    Parameters
    ----------
    points_sensor : ndarray (N, 3) float32
        Position [mm].
    normals_sensor : ndarray (N, 3) float32
        Unit normal towards the sensor.
    spacing_mm : ndarray () float64
        Median distance of neighbouring points [mm]; NaN where there are none.
    """

    points_sensor: NDArray[np.float32] = field(metadata={"unit": "mm"})
    normals_sensor: NDArray[np.float32]
    spacing_mm: Array = field(metadata={"unit": "mm"})


def footprint(measurement: Measurement) -> Footprint:
    """Return the middles of all squares of four neighbouring blocks of pixels in which points were measured."""
    grid = _block_means(measurement.points_sensor, max(1, max(measurement.shape) // _BLOCKS))
    corners = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    middle = np.mean(corners, axis=0)
    normal = np.cross(corners[3] - corners[0], corners[2] - corners[1])
    length = np.linalg.norm(normal, axis=2)
    there = length > 0  # NaN is not
    points, normals = middle[there], normal[there] / length[there][:, None]
    away = np.einsum("ij,ij->i", normals, points - measurement.camera.center_sensor) > 0
    normals[away] *= -1
    sides = np.linalg.norm(corners[1] - corners[0], axis=2), np.linalg.norm(corners[2] - corners[0], axis=2)
    spacing = np.median(np.concatenate([side[there] for side in sides])) if there.any() else np.nan
    return Footprint(points.astype(np.float32), normals.astype(np.float32), np.asarray(spacing, float))


def _block_means(points: NDArray[np.float32], size: int) -> Array:
    """Return the means (h, w, 3) of the points measured in blocks of pixels; NaN where there are none."""
    height, width = (n // size for n in points.shape[:2])
    blocks = points[: height * size, : width * size].astype(float).reshape(height, size, width, size, 3)
    measured = np.isfinite(blocks[..., 2])
    count = measured.sum((1, 3))[..., None]
    total = np.where(measured[..., None], blocks, 0).sum((1, 3))
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))
