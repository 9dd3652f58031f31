"""What the row errors of all places amount to: their slow pattern, and the orientation that would explain it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri_exp
from scipy.stats import chi2

from planish.geometry import Array
from planish.rig import Rig
from planish.sensing.rigcheck.evidence import DEGREES, FLOOR_PX, Evidence, normal_equations
from planish.sensing.rigcheck.orientation import CHANGES, moved_device, orientation_basis, reoriented
from planish.sensing.rigcheck.pairs import PixelPairs, row_errors

#: A change of the orientation this large is not told from larger ones [rad]: it keeps what nothing observes finite.
WIDEST_RAD = 0.1
#: Step of the numerical derivative of points by the orientation [rad].
STEP_RAD = 1e-6
#: Row errors that no rig makes: the patterns' own standard deviation before anything is known [px].
WIDEST_PX = 100.0
#: Combinations of slow patterns with less information than this share of the best are those of the orientation.
SEEN_SHARE = 1e-3
#: Patterns that no orientation explains are taken for real beyond so many standard deviations.
LENS_SIGMAS = 3.0
#: Where they are larger than this, no orientation is worth adjusting [px].
MAX_LEFT_PX = 0.3
#: The share of slow patterns that no orientation makes is not taken for less than this.
LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Pattern:
    """The slow pattern of row errors over the image.

    Parameters
    ----------
    mean_px, sigma_px, variation_px, rms_px, rms_sigma_px : float
        As in RigCheck.
    """

    mean_px: float
    sigma_px: float
    variation_px: float
    rms_px: float
    rms_sigma_px: float


def slow_pattern(evidence: Evidence) -> Pattern:
    """Return mean, variation and rms of what orientation and slow patterns make of the row errors, noise taken off."""
    design = np.column_stack([evidence.by_orientation, evidence.shapes])
    prior = np.concatenate([np.full(len(CHANGES), WIDEST_RAD), np.full(evidence.shapes.shape[1], WIDEST_PX)])
    scaled = design * prior
    A, b = normal_equations(evidence, scaled, ())
    values, vectors = np.linalg.eigh(A + np.eye(len(A)))
    root = vectors / np.sqrt(np.maximum(values, 1.0))
    fit = scaled @ (root @ (root.T @ b))
    spread = scaled @ root
    mean = float(fit.mean())
    sigma = float(np.hypot(np.linalg.norm(spread.mean(0)), FLOOR_PX))
    noise = float((spread**2).sum(1).mean())
    centered = spread - spread.mean(0)
    variation = float(np.sqrt(max(fit.var() - float((centered**2).sum(1).mean()), 0.0)))
    rms = float(np.sqrt(max(float((fit**2).mean()) - noise, 0.0)))
    size = max(float(np.sqrt((fit**2).mean())), 1e-9)
    rms_sigma = float(np.hypot(np.linalg.norm(fit @ spread) / (len(fit) * size), FLOOR_PX))
    return Pattern(mean, sigma, variation, rms, rms_sigma)


def equivalent_sigmas(statistic: float, freedom: int) -> float:
    """Return the standard deviations of a normal distribution that are as unlikely as a chi-square this large."""
    log_p = float(chi2.logsf(statistic, freedom))
    if not np.isfinite(log_p):
        # Beyond the range of the function: the tail of chi-square is that of its root's normal distribution.
        return float(np.sqrt(statistic))
    return max(float(-ndtri_exp(log_p - np.log(2))), 0.0)


@dataclass(frozen=True)
class Orientation:
    """Changes of the orientation that the row errors ask for.

    Parameters
    ----------
    change_rad : ndarray (5,)
        Estimate.
    information : ndarray (5, 5)
        Inverse of its covariance.
    sigmas : float
        Significance.
    """

    change_rad: Array
    information: Array
    sigmas: float

    @property
    def covariance(self) -> Array:
        """Covariance (5, 5) [rad^2]; what nothing observes has WIDEST_RAD."""
        return np.asarray(np.linalg.inv(self.information + np.eye(len(CHANGES)) / WIDEST_RAD**2), np.float64)

    def moved_by(self, change_rad: Array) -> Orientation:
        """Return the same for a rig before it was changed by (5,) [rad]."""
        return replace(self, change_rad=self.change_rad + change_rad)


def estimate_orientation(evidence: Evidence, rig: Rig | None) -> Orientation:
    """Return the change of the orientation against noise, and (rig given) against what its covariance allows too."""
    nuisance = [(evidence.shapes, np.diag(evidence.floor_px))]
    if rig is not None and rig.covariance is not None:
        nuisance.append((evidence.by_rig, rig.modes().T))
    A, b = normal_equations(evidence, evidence.by_orientation, nuisance)
    x = np.asarray(np.linalg.solve(A + np.eye(len(A)) / WIDEST_RAD**2, b), np.float64)
    statistic = float(b @ np.linalg.pinv(A, rcond=1e-10, hermitian=True) @ b)
    return Orientation(x, A, equivalent_sigmas(statistic, len(CHANGES)))


def unexplained(evidence: Evidence, rig: Rig | None) -> tuple[float, float]:
    """Return rms [px] and significance of the slow patterns of row errors that no orientation explains."""
    nuisance = [
        (evidence.by_orientation, WIDEST_RAD * np.eye(len(CHANGES))),
        (evidence.shapes, np.diag(evidence.floor_px)),
    ]
    if rig is not None and rig.covariance is not None:
        nuisance.append((evidence.by_rig, rig.modes().T))
    A, b = normal_equations(evidence, evidence.shapes, nuisance)
    values, vectors = np.linalg.eigh(A)
    # Patterns that the orientation makes too tell nothing apart from it.
    seen = values > SEEN_SHARE * values[-1]
    parts = (vectors[:, seen].T @ b) / values[seen]
    statistic = float((parts**2 * values[seen]).sum())
    left = _without_orientation(evidence)
    pattern, spread = left @ (vectors[:, seen] @ parts), left @ (vectors[:, seen] / np.sqrt(values[seen]))
    size = float((pattern**2).mean() - (spread**2).sum(1).mean())
    return float(np.sqrt(max(size, 0.0))), equivalent_sigmas(statistic, int(seen.sum()))


def with_lens_errors(evidence: Evidence, rig: Rig) -> Evidence:
    """Return the evidence with the patterns that no orientation explains as a measure of those that hide behind one.

    Errors of lenses make patterns of degree 2 and higher. Those of the shape of an orientation's are taken for as large
    as the others, which are seen: the share of such patterns that no orientation makes stands for all of them. (Of
    degree 0 and 1 are errors of principal points and distances: as row errors they are an orientation.)
    """
    size, sigmas = unexplained(evidence, rig)
    if sigmas <= LENS_SIGMAS:
        return evidence
    curved = np.array(DEGREES) >= 2
    share = float((_without_orientation(evidence)[:, curved] ** 2).sum(1).mean())
    lens = size / np.sqrt(max(share, LEAST_SHARE)) * curved
    return replace(evidence, floor_px=np.hypot(evidence.floor_px, lens))


def _without_orientation(evidence: Evidence) -> Array:
    """Return the slow patterns (n, 10) less what the orientation makes of them."""
    root = np.sqrt(evidence.information)[:, None]
    J = evidence.by_orientation
    return evidence.shapes - J @ np.linalg.lstsq(root * J, root * evidence.shapes, rcond=1e-10)[0]


def points_by_orientation(pairs: Sequence[PixelPairs], rig: Rig) -> Array:
    """Return how points move (n, 3, 5) [mm / rad] with the changes of the orientation."""
    moved, fixed = moved_device(pairs[0].own, pairs[0].other)
    basis = orientation_basis(rig, moved, fixed)
    columns = []
    for k in range(len(CHANGES)):
        changed = reoriented(rig, moved, fixed, STEP_RAD * basis[:, k])
        change = [row_errors(item, changed).points_sensor - row_errors(item, rig).points_sensor for item in pairs]
        columns.append(np.concatenate(change) / STEP_RAD)
    return np.stack(columns, -1)
