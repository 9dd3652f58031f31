"""Where two measurements overlap under a transform: centre and radius, from a coarse look-up."""

from __future__ import annotations

import numpy as np

from planish.geometry import Array
from planish.measurement import Measurement
from planish.registration.seen import nearest_pixels

#: Every n-th pixel along both axes.
_STRIDE = 8
#: Fewer common points are no overlap.
_LEAST = 10


def overlap_extent(
    a: Measurement, b: Measurement, T_a_b: Array, max_distance_mm: float = 2.0
) -> tuple[Array, float] | None:
    """Return centre (3,) in frame a and rms radius [mm] of the common surface, or None where there is none."""
    common = _common_points(a, b, T_a_b, max_distance_mm)
    if len(common) < _LEAST:
        return None
    return _middle_and_radius(common)


def rms_radius(measurement: Measurement) -> float:
    """Return the root mean square distance of a measurement's points from their middle [mm], 0 where it has none."""
    points = measurement.points_sensor[::_STRIDE, ::_STRIDE].reshape(-1, 3).astype(float)
    known = points[np.isfinite(points[:, 2])]
    return _middle_and_radius(known)[1] if len(known) else 0.0


def _middle_and_radius(points: Array) -> tuple[Array, float]:
    """Mean (3,) of points (n, 3), and their root mean square distance from it."""
    middle = points.mean(0)
    off = points - middle
    return middle, float(np.sqrt(np.einsum("ni,ni->", off, off) / len(points)))


def overlap_axes(a: Measurement, b: Measurement, T_a_b: Array, max_distance_mm: float = 2.0) -> Array:
    """Return the axes of the common surface in frame a (columns): its length, its width, its normal."""
    common = _common_points(a, b, T_a_b, max_distance_mm)
    if len(common) < _LEAST:
        return np.eye(3)
    return np.asarray(np.linalg.svd(common - common.mean(0), full_matrices=False)[2].T)


def _common_points(a: Measurement, b: Measurement, T_a_b: Array, max_distance_mm: float) -> Array:
    _, of_a, points = nearest_pixels(a, b, T_a_b, _STRIDE)
    off = a.points_sensor.reshape(-1, 3)[of_a] - points
    return np.asarray(points[np.einsum("ni,ni->n", off, off) < max_distance_mm**2])
