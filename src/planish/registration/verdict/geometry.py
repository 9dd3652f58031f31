"""Do the surfaces contradict each other: would one hide what the other camera saw?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array, invert, transform_points
from planish.measurement import Measurement

#: Every n-th pixel along both axes.
_STRIDE = 6
#: A distance counts beyond this many standard deviations of both points.
_SIGMAS = 6.0


@dataclass(frozen=True)
class Sight:
    """What both cameras say about the surfaces under a transform, in pixels looked at.

    Parameters
    ----------
    meet : int
        The surfaces lie within the gate.
    hidden : int
        A surface of one stands in front of what the other's camera saw: both cannot be true.
    """

    meet: int
    hidden: int

    @property
    def conflict(self) -> float:
        """Share of the contradictions in what can be judged."""
        return self.hidden / max(1, self.meet + self.hidden)


def line_of_sight(
    a: Measurement,
    b: Measurement,
    T_a_b: Array,
    gate_mm: float,
    without: tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None] = (None, None),
) -> Sight:
    """Return whether the surfaces hide each other from the cameras under T_a_b.

    A point that lies before the other's surface, along the other camera's ray, would have been seen instead of it. A
    point behind it says nothing: it was hidden. Both ways are counted; `without` (H, W) of a and b leaves pixels out.
    """
    first = _before(a, b, T_a_b, gate_mm, *without)
    second = _before(b, a, invert(T_a_b), gate_mm, *without[::-1])
    return Sight(first[0] + second[0], first[1] + second[1])


def _before(
    a: Measurement,
    b: Measurement,
    T_a_b: Array,
    gate_mm: float,
    without_a: NDArray[np.bool_] | None,
    without_b: NDArray[np.bool_] | None,
) -> tuple[int, int]:
    """Count of b's points on a's surface, and before it as a's camera sees it."""
    grid = np.s_[::_STRIDE, ::_STRIDE]
    known = np.isfinite(b.points_sensor[grid][..., 2])
    if without_b is not None:
        known &= ~without_b[grid]
    points = np.asarray(transform_points(T_a_b, b.points_sensor[grid][known].astype(float)), float)
    sigma_b = b.sigma_mm[grid][known].astype(float)
    pixels = np.rint(a.camera.project(points))
    height, width = a.shape
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < [width, height])).all(1)
    u, v = pixels[inside].astype(int).T
    other = a.points_sensor[v, u].astype(float)
    centre = a.camera.center_sensor
    nearer = np.linalg.norm(other - centre, axis=1) - np.linalg.norm(points[inside] - centre, axis=1)
    gate = np.maximum(gate_mm, _SIGMAS * np.hypot(a.sigma_mm[v, u].astype(float), sigma_b[inside]))
    seen = np.isfinite(nearer)
    if without_a is not None:
        seen &= ~without_a[v, u]
    nearer, gate = nearer[seen], gate[seen]
    return int((np.abs(nearer) <= gate).sum()), int((nearer > gate).sum())
