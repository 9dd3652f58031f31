"""Do the surfaces contradict each other: would one hide what the other camera saw?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array, invert
from planish.measurement import Measurement
from planish.registration.seen import nearest_pixels

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
    of_b, of_a, points = nearest_pixels(a, b, T_a_b, _STRIDE)
    centre = a.camera.center_sensor
    rays = (x - centre for x in (a.points_sensor.reshape(-1, 3)[of_a], points))
    other, own = (np.sqrt(np.einsum("ni,ni->n", ray, ray)) for ray in rays)
    nearer = other - own
    variances = (m.sigma_mm.ravel()[at].astype(float) ** 2 for m, at in ((a, of_a), (b, of_b)))
    gate = np.maximum(gate_mm, _SIGMAS * np.sqrt(sum(variances)))
    seen = np.isfinite(nearer)
    for without, at in ((without_a, of_a), (without_b, of_b)):
        if without is not None:
            seen &= ~without.ravel()[at]
    nearer, gate = nearer[seen], gate[seen]
    return int((np.abs(nearer) <= gate).sum()), int((nearer > gate).sum())
