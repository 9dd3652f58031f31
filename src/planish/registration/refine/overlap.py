"""Where two measurements overlap under a transform: centre and radius, from a coarse look-up."""

from __future__ import annotations

import numpy as np

from planish.geometry import Array, transform_points
from planish.measurement import Measurement

#: Every n-th pixel along both axes.
_STRIDE = 8


def overlap_extent(
    a: Measurement, b: Measurement, T_a_b: Array, max_distance_mm: float = 2.0
) -> tuple[Array, float] | None:
    """Return centre (3,) in frame a and rms radius [mm] of the common surface, or None where there is none."""
    points_b = b.points_sensor[::_STRIDE, ::_STRIDE].reshape(-1, 3).astype(float)
    points = np.asarray(transform_points(T_a_b, points_b[np.isfinite(points_b[:, 2])]), float)
    pixels = np.rint(a.camera.project(points))
    height, width = a.shape
    inside = ((pixels >= 0) & (pixels < [width, height])).all(1)
    u, v = pixels[inside].astype(int).T
    near = np.linalg.norm(a.points_sensor[v, u] - points[inside], axis=1) < max_distance_mm
    common = points[inside][near]
    if len(common) < 10:
        return None
    centre = common.mean(0)
    return centre, float(np.sqrt(((common - centre) ** 2).sum(1).mean()))
