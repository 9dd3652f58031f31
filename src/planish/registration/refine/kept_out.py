"""What the tiles that took no part in a fit say about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from planish.geometry import Array
from planish.registration.refine.covariance import noise_covariance
from planish.registration.refine.information import held_directions, information
from planish.registration.refine.residuals import equations
from planish.registration.refine.sides import JointSide
from planish.registration.refine.solve import MIN_POINTS, Refined, RefineOptions

#: A disagreement that the stated covariances produce less often than this is none of them.
_LOG10_CHANCE = -4.0


@dataclass(frozen=True)
class Agreement:
    """How the step that the tiles kept out would make compares with the covariances of both.

    Parameters
    ----------
    chi_squared : float
        Squared step over its covariance, that of the fit and their own.
    directions : int
        Directions that they hold.
    shift_mm : float
        Length of the step at the rim of the overlap [mm].
    """

    chi_squared: float
    directions: int
    shift_mm: float

    @property
    def contradicts(self) -> bool:
        """Whether chance does not explain the disagreement."""
        if self.directions == 0:
            return False
        return bool(chi2.logsf(self.chi_squared, self.directions) < _LOG10_CHANCE * np.log(10))

    @property
    def factor(self) -> float:
        """By how much the stated covariance is too small: 1 as long as chance explains what is seen (Birge 1932)."""
        return self.chi_squared / self.directions if self.contradicts else 1.0


def agreement(
    a: JointSide,
    b: JointSide,
    refined: Refined,
    covariance: Array,
    tile_px: int,
    options: RefineOptions | None = None,
    threads: int = 1,
) -> Agreement:
    """Return how pixels of a that took no part in the fit agree with it.

    Parameters
    ----------
    a, b : JointSide
        Of the last level; a uses only what was kept out.
    refined : Refined
    covariance : ndarray (6, 6)
        Of the noise of the fit.
    tile_px : int
        Edge of the tiles of b [px].
    options : RefineOptions, optional
    threads : int, optional

    Notes
    -----
    The Newton step of what was kept out is independent of the fit: its covariance is that of the fit and its own. What
    displaces both alike (blur, calibration) is not seen.
    """
    options = options or RefineOptions()
    e = equations(
        a, b, refined.T_a_b, refined.about, refined.weights, max_distance_mm=options.max_distance_mm[-1],
        max_normal_rad=options.max_normal_rad, stride=1, tile_px=tile_px, residuals=False, threads=threads,
    )  # fmt: skip
    if e.points < MIN_POINTS:
        return Agreement(0.0, 0, 0.0)
    own = Refined(refined.T_a_b, refined.about, refined.lever_mm, e, refined.weights, True, 0.0)
    info = information(e, refined.lever_mm)
    V, values = held_directions(info, options.max_sigma_mm)
    step = (V.T @ (info.scale * info.gradient)) / values
    # Scaled, the directions are orthonormal: each is its own row of the inverse.
    across = V * info.scale[:, None] ** 2
    C = across.T @ (noise_covariance(own) + covariance) @ across
    return Agreement(float(step @ np.linalg.solve(C, step)), len(step), float(np.linalg.norm(step)))
