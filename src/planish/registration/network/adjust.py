"""Network adjustment: the transforms of all measurements that agree best with all pairs, by their covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from planish.geometry import Array, adjoint, difference, invert, perturb, transform_points, translation
from planish.options import Options
from planish.registration.result import PairResult


class NetworkOptions(Options):
    """Options of the network adjustment."""

    #: Gauss-Newton steps; pairs are good to far less than a degree, so that few are needed.
    max_steps: int = Field(default=20, ge=1)
    #: A pair in a loop that contradicts the others by more than this is a blunder [mm] ...
    blunder_mm: float = Field(default=0.5, gt=0)
    #: ... if it is also more than this many of its standard deviations.
    blunder_sigma: float = Field(default=6.0, gt=0)


@dataclass(frozen=True)
class Adjusted:
    """Adjusted transforms of one group.

    Parameters
    ----------
    T_world_measurement : dict
        Per name, (4, 4); world is the reference's frame.
    covariance : dict
        Per name, (6, 6), of xi about the own centroid in world; zero for the reference.
    residual_mm : dict
        Per pair (a, b): how far the pair puts its overlap's centre from where the other pairs put it [mm]; 0 where
        nothing else ties the two together.
    residual_sigma : dict
        The same in standard deviations of noise and calibration (root of the quadratic form over the degrees of
        freedom).
    noise_sigma : dict
        The same by noise alone, the weights of the adjustment: the pair to blame has the largest one.
    variance_factor : float
        Sum of squared normalised residuals over the redundancy and what errors of the calibration add to it; 1 where
        there is no loop.
    calibration : dict or None
        Per name, the motions xi (k, 6) by all modes of all rigs, about the own centroid in world: errors of the
        calibration are common to all measurements of a rig. None where a pair in use states none.
    """

    T_world_measurement: dict[str, Array]
    covariance: dict[str, Array]
    residual_mm: dict[tuple[str, str], float]
    residual_sigma: dict[tuple[str, str], float]
    noise_sigma: dict[tuple[str, str], float]
    variance_factor: float
    calibration: dict[str, Array] | None


def adjust(
    start: Mapping[str, Array],
    reference: str,
    pairs: Sequence[PairResult],
    centroids: Mapping[str, Array],
    options: NetworkOptions | None = None,
) -> Adjusted:
    """Return the least-squares transforms of one group.

    Parameters
    ----------
    start : mapping
        T_world_measurement (4, 4) per name.
    reference : str
        Its frame is the world; it does not move.
    pairs : sequence of PairResult
        Those with `used` count.
    centroids : mapping
        Centroid (3,) of each measurement in its own frame [mm].
    """
    options = options or NetworkOptions()
    T = dict(start)
    free = sorted(name for name in T if name != reference)
    column = {name: 6 * i for i, name in enumerate(free)}
    edges = [p for p in pairs if p.used and p.a in T and p.b in T]
    information: list[Array] = [np.asarray(np.linalg.inv(_required(p.covariance_noise)), np.float64) for p in edges]
    N = np.zeros((6 * len(free), 6 * len(free)))
    for _ in range(options.max_steps):
        N[:] = 0
        rhs = np.zeros(6 * len(free))
        for pair, W in zip(edges, information, strict=True):
            r, J = _residual(pair, T, centroids)
            for name, Ji in J.items():
                if name == reference:
                    continue
                i = column[name]
                rhs[i : i + 6] += Ji.T @ W @ r
                for other, Jj in J.items():
                    if other != reference:
                        N[i : i + 6, column[other] : column[other] + 6] += Ji.T @ W @ Jj
        if not free:
            break
        x = _solve(N, rhs)
        for name in free:
            xi = x[column[name] : column[name] + 6]
            T[name] = perturb(T[name], xi, transform_points(T[name], np.asarray(centroids[name], float)))
        if np.abs(x).max() < 1e-9:
            break
    return _result(T, reference, free, column, edges, information, centroids, N)


def _result(
    T: dict[str, Array],
    reference: str,
    free: Sequence[str],
    column: Mapping[str, int],
    edges: Sequence[PairResult],
    information: Sequence[Array],
    centroids: Mapping[str, Array],
    N: Array,
) -> Adjusted:
    inverse = _solve(N, np.eye(len(N)))
    residuals, rows = [], []
    for pair in edges:
        r, J = _residual(pair, T, centroids)
        A = np.zeros((6, len(N)))
        for name in J.keys() & column.keys():
            A[:, column[name] : column[name] + 6] = J[name]
        residuals.append(r)
        rows.append(A)
    shifts = _common_shifts(edges)
    # The network follows the pairs' errors by the gain of the least squares, one mode of a rig at a time.
    pulls = (A.T @ W @ shift.T for A, W, shift in zip(rows, information, shifts, strict=True))
    moved = inverse @ sum(pulls, np.zeros((len(N), 0 if not shifts else len(shifts[0]))))
    residual_mm, residual_sigma, noise_sigma, total, by_calibration = {}, {}, {}, 0.0, 0.0
    for pair, W, r, A, shift in zip(edges, information, residuals, rows, shifts, strict=True):
        left = shift.T - A @ moved
        total += float(r @ W @ r)
        by_calibration += float(np.sum(left * (W @ left)))
        gap, *sigmas = _contradiction(r, _required(pair.covariance_noise), A @ inverse @ A.T, left)
        residual_mm[pair.a, pair.b] = float(np.linalg.norm(gap[3:]))
        residual_sigma[pair.a, pair.b], noise_sigma[pair.a, pair.b] = sigmas
    redundancy = 6 * (len(edges) - len(free))
    # Errors of the rig that measurements do not share alike open loops too: they are expected.
    factor = total / (redundancy + by_calibration) if redundancy > 0 else 1.0
    # Loops that close worse than the pairs' covariances promise speak for errors that those leave out.
    inverse = inverse * max(1.0, factor)
    covariance = {name: inverse[column[name] : column[name] + 6, column[name] : column[name] + 6] for name in free}
    covariance[reference] = np.zeros((6, 6))
    calibration = None
    if edges and all(pair.calibration_shifts is not None for pair in edges):
        calibration = {name: moved[column[name] : column[name] + 6].T for name in free}
        calibration[reference] = np.zeros((moved.shape[1], 6))
    return Adjusted(T, covariance, residual_mm, residual_sigma, noise_sigma, factor, calibration)


def _common_shifts(edges: Sequence[PairResult]) -> list[Array]:
    """Return per pair its shifts (k, 6) by all modes of all rigs in the group; zero by rigs of other measurements."""
    stated = [dict(pair.calibration_shifts or {}) for pair in edges]
    modes = {key: len(xi) for shifts in stated for key, xi in shifts.items()}
    return [
        np.concatenate([np.zeros((0, 6)), *(shifts.get(key, np.zeros((modes[key], 6))) for key in sorted(modes))])
        for shifts in stated
    ]


def _contradiction(r: Array, C: Array, C_adjusted: Array, calibration: Array) -> tuple[Array, float, float]:
    """Difference xi of a pair from what all others say, its size in standard deviations, and that by noise alone.

    A certain pair pulls the network along, so that its residual r alone shows little of its error; the covariance of r,
    C - C_adjusted, undoes that (data snooping, Baarda 1968). Directions that no other pair controls count nothing.
    `calibration` (6, k) is what each mode of the rigs leaves in r: it adds to what r may be.
    """
    d = np.sqrt(np.diag(C))
    values, vectors = np.linalg.eigh((C - C_adjusted) / np.outer(d, d))
    controlled = values > _UNCONTROLLED
    V = vectors[:, controlled]
    z, modes = V.T @ (r / d), V.T @ (calibration / d[:, None])
    gap = C @ (V @ (z / values[controlled]) / d)
    spread = np.diag(values[controlled]) + modes @ modes.T
    sigma, by_noise = z @ np.linalg.solve(spread, z), z @ (z / values[controlled])
    return gap, float(np.sqrt(sigma / 6)), float(np.sqrt(by_noise / 6))


#: Share of a pair's variance left to its residual below which only rounding is left of it.
_UNCONTROLLED = 1e-6


def _residual(
    pair: PairResult, T: Mapping[str, Array], centroids: Mapping[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Return xi from the network's T_a_b to the pair's, and the change of the network's part per measurement."""
    T_a_world = invert(T[pair.a])
    p = _required(pair.covariance_point_mm)
    predicted = T_a_world @ T[pair.b]
    r = difference(_required(pair.T_a_b), predicted, p)
    J = {}
    for name, sign in ((pair.b, 1.0), (pair.a, -1.0)):
        centre = transform_points(T[name], np.asarray(centroids[name], float))
        # A small motion of b about its centroid in world, seen in a about p; the same motion of a acts the other way.
        J[name] = sign * adjoint(translation(-p) @ T_a_world @ translation(centre))
    return r, J


def _solve(N: Array, rhs: Array) -> Array:
    if len(N) == 0:
        return np.zeros_like(rhs)
    # Rotations [rad] and translations [mm] differ by orders of magnitude: scale to a unit diagonal first.
    d = 1 / np.sqrt(np.diag(N))
    scaled = np.linalg.solve(N * np.outer(d, d), rhs * (d if rhs.ndim == 1 else d[:, None]))
    return scaled * (d if rhs.ndim == 1 else d[:, None])


def _required(value: Array | None) -> Array:
    assert value is not None, "an accepted pair carries transform, covariance and point"
    return value
