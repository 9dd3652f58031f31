"""Matches: places of two measurements that look alike, each with its local frame; what the consensus works on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array


@dataclass(frozen=True)
class Matches:
    """M pairs of places, best first; wherever they come from (keypoints, windows), the same goes on with them.

    Parameters
    ----------
    points_a, points_b : ndarray (M, 3)
        Positions in the sensor frames of a and b [mm].
    frames_a, frames_b : ndarray (M, 3, 3)
        Columns: orientation of the texture in the tangent plane, normal x orientation, normal. One match alone fixes
        the rotation R_a_b = frames_a @ frames_b.T.
    pixels_a, pixels_b : ndarray (M, 2)
        Pixels (u, v) of the organising cameras.
    correlation : ndarray (M,)
        Normalised cross-correlation of the aligned patches; NaN where it was not computed.
    """

    points_a: Array = field(metadata={"unit": "mm"})
    points_b: Array = field(metadata={"unit": "mm"})
    frames_a: Array
    frames_b: Array
    pixels_a: Array = field(metadata={"unit": "px"})
    pixels_b: Array = field(metadata={"unit": "px"})
    correlation: Array

    def __len__(self) -> int:
        return len(self.points_a)

    def take(self, index: NDArray[Any]) -> Matches:
        """Return the matches at `index` (indices or mask)."""
        return Matches(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def no_matches() -> Matches:
    """Return no matches."""
    points, frames, pixels = np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2))
    return Matches(points, points, frames, frames, pixels, pixels, np.empty(0))
