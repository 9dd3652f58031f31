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
        The same in standard deviations (root of the quadratic form over the degrees of freedom).
    variance_factor : float
        Sum of squared normalised residuals over the redundancy; 1 where there is no loop.
    """

    T_world_measurement: dict[str, Array]
    covariance: dict[str, Array]
    residual_mm: dict[tuple[str, str], float]
    residual_sigma: dict[tuple[str, str], float]
    variance_factor: float


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
    residual_mm, residual_sigma, total = {}, {}, 0.0
    inverse = _solve(N, np.eye(len(N)))
    for pair, W in zip(edges, information, strict=True):
        r, J = _residual(pair, T, centroids)
        total += float(r @ W @ r)
        A = np.zeros((6, len(N)))
        for name in J.keys() & column.keys():
            A[:, column[name] : column[name] + 6] = J[name]
        gap, sigma = _contradiction(r, _required(pair.covariance_noise), A @ inverse @ A.T)
        residual_mm[pair.a, pair.b] = float(np.linalg.norm(gap[3:]))
        residual_sigma[pair.a, pair.b] = sigma
    redundancy = 6 * (len(edges) - len(free))
    factor = total / redundancy if redundancy > 0 else 1.0
    # Loops that close worse than the pairs' covariances promise speak for errors that those leave out.
    inverse = inverse * max(1.0, factor)
    covariance = {name: inverse[column[name] : column[name] + 6, column[name] : column[name] + 6] for name in free}
    covariance[reference] = np.zeros((6, 6))
    return Adjusted(T, covariance, residual_mm, residual_sigma, factor)


def _contradiction(r: Array, C: Array, C_adjusted: Array) -> tuple[Array, float]:
    """Difference xi of a pair from what all others say, and its size in standard deviations.

    A certain pair pulls the network along, so that its residual r alone shows little of its error; the covariance of r,
    C - C_adjusted, undoes that (data snooping, Baarda 1968). Directions that no other pair controls count nothing.
    """
    d = np.sqrt(np.diag(C))
    values, vectors = np.linalg.eigh((C - C_adjusted) / np.outer(d, d))
    controlled = values > _UNCONTROLLED
    z = vectors[:, controlled].T @ (r / d)
    gap = C @ (vectors[:, controlled] @ (z / values[controlled]) / d)
    return gap, float(np.sqrt(z @ (z / values[controlled]) / 6))


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
