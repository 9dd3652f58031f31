"""The anchor: what windows of weak textures say about the transform, beside single pixels.

Where a pixel holds more noise than texture, the slope of its residual is mostly noise, and sums over pixels hold a
direction badly. The peak of a window's correlation does not depend on slopes. Its scatter is known from all windows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from planish.geometry import Array, difference
from planish.registration.refine.residuals import Equations

#: Windows see the same textures as the pixels do: counted by this factor less, both together never claim more than
#: twice what there is, and never less than the better of both.
_SHARED = 2.0


@dataclass(frozen=True)
class Anchor:
    """A transform that the refinement starts from and is held to.

    Parameters
    ----------
    T_a_b : ndarray (4, 4)
        Where the windows lie best on each other.
    points_a : ndarray (n, 3)
        Their middles [mm].
    sigma_mm : float
        Standard deviation of one window along each axis [mm].
    """

    T_a_b: Array
    points_a: Array
    sigma_mm: float

    def hold(self, equations: Equations, T_a_b: Array, about: Array) -> Equations:
        """Return the normal equations at T_a_b, rotations about a point, with those of the windows."""
        lever = self.points_a - about
        J = np.zeros((len(lever), 3, 6))
        J[:, :, 3:] = np.eye(3)
        # d(point) = rotation x lever + translation.
        for axis in range(3):
            J[:, :, axis] = np.cross(np.eye(3)[axis], lever)
        H = np.einsum("nij,nik->jk", J, J) / (_SHARED * self.sigma_mm**2)
        return replace(equations, H_anchor=H, g_anchor=H @ difference(T_a_b, self.T_a_b, about))
