"""The relative orientation that row errors ask for, and the covariance of the rig after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.rig import Rig
from planish.sensing.rigcheck.change_size import likely_size, likely_sizes
from planish.sensing.rigcheck.check import evidence_of
from planish.sensing.rigcheck.estimates import (
    LENS_SIGMAS,
    MAX_LEFT_PX,
    WIDEST_RAD,
    Pattern,
    estimate_orientation,
    slow_pattern,
    unexplained,
    with_lens_errors,
)
from planish.sensing.rigcheck.evidence import FLOOR_PX, Evidence, gather
from planish.sensing.rigcheck.orientation import (
    CHANGES,
    external_names,
    moved_device,
    orientation_basis,
    reoriented,
    with_names,
    without_baseline_length,
)
from planish.sensing.rigcheck.pairs import PixelPairs

#: Linearisations; a second one takes 0.3 degrees to 1e-4 px.
ITERATIONS = 4
#: Trials of few changes, and what they may leave, in standard deviations.
SPARSE_TRIALS, LEFT_SIGMAS = 4, 2.0
#: Variance, as a share of a parameter's own, that is rounding.
SINGULAR = 1e-12


@dataclass(frozen=True)
class Adjustment:
    """A rig with another relative orientation.

    Parameters
    ----------
    rig : Rig
        The adjusted rig with its new covariance; the rig as it was where the adjustment was refused.
    refusal : str
        Why nothing was adjusted; empty where it was.
    change_rad : ndarray (5,)
        Change of the orientation (CHANGES).
    sigma_rad : ndarray (5,)
        Its standard deviation afterwards.
    told : ndarray (5,)
        Share of each change's variance before that the row errors took away: 0 = they say nothing about it.
    size_rad : float
        How large a change the row errors suggest; 0 where noise and the rig's covariance explain them.
    left_px, left_sigma_px : float
        Row error that is left, rms of its slow pattern over the image [px], and its standard deviation.
    """

    rig: Rig
    refusal: str
    change_rad: Array
    sigma_rad: Array
    told: Array
    size_rad: float
    left_px: float
    left_sigma_px: float


def adjust_orientation(pairs: Sequence[PixelPairs], rig: Rig) -> Adjustment:
    """Return the rig with the relative orientation that row errors and the rig's covariance make most likely.

    Parameters
    ----------
    pairs : sequence of PixelPairs
        Of one and the same two devices, points in the sensor frame of `rig`.
    rig : Rig
        As it was when measured.

    Notes
    -----
    Prior: the rig's covariance, and changes of unknown sizes (planish.sensing.rigcheck.change_size): one for all five,
    from which the uncertainty follows, and one for each, most of them 0, from which the orientation follows. For a
    change that row errors hardly see would be adjusted to noise, at the cost of depth. The expected square error of the
    sparse estimate is the covariance of the other one and the square of their difference.

    Only the orientation is changed: the part of it that the other parameters do not bring along,
    dx' = dx - C_xc C_cc^-1 dc, for a calibration keeps its parameters in tune with each other. The covariance
    afterwards holds for any gain (Joseph form).
    """
    evidence = evidence_of(pairs, rig)
    first, pattern = with_lens_errors(evidence, rig), slow_pattern(evidence)
    left_px, left_sigmas = unexplained(evidence, rig)
    if left_px > MAX_LEFT_PX and left_sigmas > LENS_SIGMAS:
        return _refused(
            rig, pattern, f"a pattern of {left_px:.2f} px rms over the image is none that an orientation makes"
        )  # fmt: skip
    moved, fixed = moved_device(pairs[0].own, pairs[0].other)
    names = with_names(rig.covariance_parameters if rig.covariance is not None else (), external_names(moved))
    task = _Task(pairs, rig, moved, fixed, names, first.floor_px)
    size = likely_size(estimate_orientation(first, rig))
    full = task.solve(np.full(len(CHANGES), size))
    if full is None:
        return _refused(rig, pattern, "the row errors do not lead to an orientation near that of the rig")
    sparse = task.sparse(full) if size > 0 else full
    left = slow_pattern(gather(pairs, sparse.rig, ()))
    if left.rms_px > pattern.rms_px + pattern.rms_sigma_px:
        return _refused(rig, pattern, "no other orientation makes the row errors smaller")
    covariance = full.covariance.copy()
    covariance[np.ix_(task.places, task.places)] += np.outer(full.total - sparse.total, full.total - sparse.total)
    before, after = (task.variances(c) for c in (full.prior @ full.prior.T, covariance))
    told = np.where(before > 0, 1 - after / np.where(before > 0, before, 1.0), 0.0)
    adjusted = _with_covariance(sparse.rig, covariance, names)
    change = task.changes(sparse.total)
    return Adjustment(adjusted, "", change, np.sqrt(np.maximum(after, 0)), told, size, left.rms_px, left.rms_sigma_px)


@dataclass(frozen=True)
class _Solution:
    """An orientation for one prior: its change (6,), rig, evidence there, prior's factor and covariance after it."""

    total: Array
    rig: Rig
    evidence: Evidence
    prior: Array
    covariance: Array


@dataclass(frozen=True)
class _Task:
    """What is adjusted to what."""

    pairs: Sequence[PixelPairs]
    rig: Rig
    moved: str
    fixed: str
    names: tuple[str, ...]
    floor_px: Array

    @property
    def places(self) -> list[int]:
        """Places of the external parameters among the names."""
        return [self.names.index(name) for name in external_names(self.moved)]

    @property
    def basis(self) -> Array:
        """From the five changes to the external parameters (6, 5)."""
        return orientation_basis(self.rig, self.moved, self.fixed)

    def changes(self, total: Array) -> Array:
        """Return the five changes [rad] of external parameters' change (6,)."""
        return np.asarray(np.linalg.pinv(self.basis) @ total)

    def variances(self, covariance: Array) -> Array:
        """Return the variances (5,) of the changes by a covariance of the names."""
        back = np.linalg.pinv(self.basis)
        return np.asarray((back @ covariance[np.ix_(self.places, self.places)] @ back.T).diagonal())

    def solve(self, sizes: Array) -> _Solution | None:
        """Return the orientation for changes of these sizes (5,) [rad]; None where it runs away."""
        places = self.places
        L, own = _prior(self.rig, self.names, places, self.basis * sizes)
        allowed = without_baseline_length(self.rig, self.moved, self.fixed)
        total, current = np.zeros(len(places)), self.rig
        for _ in range(ITERATIONS):
            evidence = replace(gather(self.pairs, current, self.names), floor_px=self.floor_px)
            gain = _placed(allowed @ _gain(evidence, L, own)[places], places, len(self.names))
            total = (gain @ (evidence.error_px + evidence.by_rig[:, places] @ total))[places]
            if not np.isfinite(total).all() or np.abs(total[:3]).max() > WIDEST_RAD:
                return None
            current = reoriented(self.rig, self.moved, self.fixed, total) if total.any() else self.rig
        evidence = replace(gather(self.pairs, current, self.names), floor_px=self.floor_px)
        return _Solution(total, current, evidence, L, _posterior(evidence, L, gain))

    def sparse(self, full: _Solution) -> _Solution:
        """Return the orientation by the fewest changes that leave nothing significant; `full` where there is none."""
        near, least_px = full, slow_pattern(full.evidence).rms_px
        for _ in range(SPARSE_TRIALS):
            left = estimate_orientation(near.evidence, self.rig)
            found = self.solve(likely_sizes(left.moved_by(self.changes(near.total))))
            if found is None:
                return full
            # The likelihood is that of the linearisation at `near`, and blind to what may be the lenses'.
            sigmas = estimate_orientation(found.evidence, self.rig).sigmas
            if sigmas < LEFT_SIGMAS and slow_pattern(found.evidence).rms_px < least_px + FLOOR_PX:
                return found
            near = found
        return full


def _refused(rig: Rig, pattern: Pattern, why: str) -> Adjustment:
    none = np.zeros(len(CHANGES))
    return Adjustment(rig, why, none, none, none, 0.0, pattern.rms_px, pattern.rms_sigma_px)


def _prior(rig: Rig, names: tuple[str, ...], places: Sequence[int], change: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return L (n, k) with L L' the covariance before, and which columns move the orientation alone.

    The others move the remaining parameters, and the orientation with them as far as it is correlated.
    """
    n, x = len(names), np.zeros(len(names), np.bool_)
    x[places] = True
    C = np.zeros((n, n))
    if rig.covariance is not None:
        m = len(rig.covariance_parameters)
        C[:m, :m] = rig.covariance
    scale = np.sqrt(np.diag(C))
    scale[scale == 0] = 1.0
    S = C / np.outer(scale, scale)
    tuned = np.linalg.pinv(S[np.ix_(~x, ~x)], rcond=SINGULAR, hermitian=True)
    rest = _root(S[np.ix_(~x, ~x)])
    along = np.zeros((n, rest.shape[1]))
    along[~x], along[x] = rest, S[np.ix_(x, ~x)] @ tuned @ rest
    alone = _root(S[np.ix_(x, x)] - along[x] @ along[x].T)
    own = np.zeros((n, alone.shape[1]))
    own[x] = alone
    # `places` are in the order of EXTERNAL, a mask in that of the names.
    L = np.column_stack([along * scale[:, None], own * scale[:, None], _placed(change, places, n)])
    return L, np.arange(L.shape[1]) >= along.shape[1]


def _root(C: Array) -> Array:
    """Return L with L L' = C, without what is rounding."""
    values, vectors = np.linalg.eigh(C)
    used = values > SINGULAR
    return np.asarray(vectors[:, used] * np.sqrt(values[used]))


def _placed(rows: Array, places: Sequence[int], count: int) -> Array:
    out = np.zeros((count, rows.shape[1]))
    out[places] = rows
    return out


def _gain(evidence: Evidence, L: Array, own: NDArray[np.bool_]) -> Array:
    """Return K (m, n) of the linear estimate of the parameters from row errors.

    K = L (1 + B' W B)^-1 B' W restricted to the columns `own` of L, B = [J L, slow patterns]: what else makes row
    errors is estimated along with them, and thrown away.
    """
    W = evidence.information
    B = np.column_stack([evidence.by_rig @ L, evidence.floor_px * evidence.shapes])
    inner = np.linalg.solve(np.eye(B.shape[1]) + (B.T * W) @ B, B.T * W)
    return np.asarray(L[:, own] @ inner[: L.shape[1]][own])


def _posterior(evidence: Evidence, L: Array, gain: Array) -> Array:
    """Return (1 - K J) C (1 - K J)' + K V K', which holds for any gain K."""
    keep = evidence.weight > 0
    K, J, shapes = gain[:, keep], evidence.by_rig[keep], evidence.floor_px * evidence.shapes[keep]
    left = L - K @ (J @ L)
    noise = K * evidence.sigma_px[keep]
    covariance = left @ left.T + noise @ noise.T + (K @ shapes) @ (K @ shapes).T
    return np.asarray(0.5 * (covariance + covariance.T))


def _with_covariance(rig: Rig, covariance: Array, names: tuple[str, ...]) -> Rig:
    used = [k for k in range(len(names)) if names[k] in rig.covariance_parameters or covariance[k, k] > 0]
    if not used:
        return rig
    return replace(
        rig, covariance=covariance[np.ix_(used, used)], covariance_parameters=tuple(names[k] for k in used)
    )  # fmt: skip
