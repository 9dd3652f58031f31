"""The relative orientation that row errors ask for, and the covariance of the rig after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.rig import Rig
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
from planish.sensing.rigcheck.evidence import Evidence, gather
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
#: How large a change of the orientation may have been [rad]: none, and powers from 1e-5 to 0.1.
CHANGE_SIZES_RAD = (0.0, *np.geomspace(1e-5, 0.1, 49))
#: A change is taken for real where it makes the row errors more likely by this much (natural logarithm): with less,
#: noise is explained as well.
LEAST_GAIN = 4.0
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
    Prior: the rig's covariance, and a change of unknown size: standard deviation s [rad] of each of CHANGES, with the s
    that makes the row errors most likely (maximum of the marginal likelihood; Bishop 2006, 3.5). Then the row errors
    decide what they see, and what they do not see stays where it was, uncertain by s. Only the orientation is changed:
    the part of it that the other parameters do not bring along, dx' = dx - C_xc C_cc^-1 dc, for a calibration keeps its
    parameters in tune with each other. The covariance afterwards holds for any gain (Joseph form).
    """
    evidence = evidence_of(pairs, rig)
    first, pattern = with_lens_errors(evidence, rig), slow_pattern(evidence)
    left_px, left_sigmas = unexplained(evidence, rig)
    if left_px > MAX_LEFT_PX and left_sigmas > LENS_SIGMAS:
        return _refused(
            rig, pattern, f"a pattern of {left_px:.2f} px rms over the image is none that an orientation makes"
        )  # fmt: skip
    moved, fixed = moved_device(pairs[0].own, pairs[0].other)
    external = external_names(moved)
    names = with_names(rig.covariance_parameters if rig.covariance is not None else (), external)
    places = [names.index(name) for name in external]
    size = likely_change(first, rig)
    basis = orientation_basis(rig, moved, fixed)
    L, own = _prior(rig, names, places, size * basis)
    allowed = without_baseline_length(rig, moved, fixed)
    total, current = np.zeros(len(external)), rig
    for _ in range(ITERATIONS):
        evidence = replace(gather(pairs, current, names), floor_px=first.floor_px)
        gain = _placed(allowed @ _gain(evidence, L, own)[places], places, len(names))
        total = (gain @ (evidence.error_px + evidence.by_rig[:, places] @ total))[places]
        if not np.isfinite(total).all() or np.abs(total[:3]).max() > WIDEST_RAD:
            return _refused(rig, pattern, "the row errors do not lead to an orientation near that of the rig")
        current = reoriented(rig, moved, fixed, total) if total.any() else rig
    covariance = _posterior(evidence, L, gain)
    left = slow_pattern(gather(pairs, current, ()))
    if left.rms_px > pattern.rms_px + pattern.rms_sigma_px:
        return _refused(rig, pattern, "no other orientation makes the row errors smaller")
    back = np.linalg.pinv(basis)
    before, after = ((back @ c[np.ix_(places, places)] @ back.T).diagonal() for c in (L @ L.T, covariance))
    told = np.where(before > 0, 1 - after / np.where(before > 0, before, 1.0), 0.0)
    adjusted = _with_covariance(current, covariance, names)
    sigma = np.sqrt(np.maximum(after, 0))
    return Adjustment(adjusted, "", back @ total, sigma, told, size, left.rms_px, left.rms_sigma_px)


def _refused(rig: Rig, pattern: Pattern, why: str) -> Adjustment:
    none = np.zeros(len(CHANGES))
    return Adjustment(rig, why, none, none, none, 0.0, pattern.rms_px, pattern.rms_sigma_px)


def likely_change(evidence: Evidence, rig: Rig) -> float:
    """Return the size [rad] of a change of the orientation that makes the row errors most likely; 0 for none."""
    found = estimate_orientation(evidence, rig)
    values, vectors = np.linalg.eigh(found.information)
    seen = values > 1e-10 * values[-1]
    variance = 1 / values[seen]
    parts = vectors[:, seen].T @ found.change_rad
    likely = [
        -0.5 * float((np.log(variance + s**2) + parts**2 / (variance + s**2)).sum()) for s in CHANGE_SIZES_RAD
    ]  # fmt: skip
    best = int(np.argmax(likely))
    return CHANGE_SIZES_RAD[best] if likely[best] - likely[0] > LEAST_GAIN else 0.0


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
