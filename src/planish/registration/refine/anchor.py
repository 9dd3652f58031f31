"""The anchor: what windows of weak textures say about the transform, beside single pixels.

Where a pixel holds more noise than texture, the slope of its residual is mostly noise, and sums over pixels hold a
direction badly. The peak of a window's correlation does not depend on slopes. Its scatter is known from all windows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, difference, perturb

#: Windows see the same textures as the pixels do: counted by this factor less, both together never claim more than
#: twice what there is, and never less than the better of both.
_SHARED = 2.0


@dataclass(frozen=True)
class Anchor:
    """A transform that a refined one is held to.

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

    def combined(self, T_a_b: Array, covariance: Array, about: Array) -> tuple[Array, Array]:
        """Return the weighted mean of a transform and this one, and its covariance (6, 6) about a point of frame a."""
        information = np.linalg.inv(covariance)
        own = self.information(about)
        C = np.linalg.inv(information + own)
        xi = -C @ own @ difference(T_a_b, self.T_a_b, about)
        return perturb(T_a_b, xi, about), (C + C.T) / 2

    def information(self, about: Array) -> Array:
        """Return the information (6, 6) of the windows on xi about a point of frame a."""
        lever = self.points_a - about
        J = np.zeros((len(lever), 3, 6))
        J[:, :, 3:] = np.eye(3)
        # d(point) = rotation x lever + translation.
        for axis in range(3):
            J[:, :, axis] = np.cross(np.eye(3)[axis], lever)
        return np.asarray(np.einsum("nij,nik->jk", J, J) / (_SHARED * self.sigma_mm**2))
