"""Normal equations with the places of the board eliminated view by view (Schur complement)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planish.geometry import Array
from planish.sensing.calibrate.adjust.linear import PLACE, Linear
from planish.sensing.calibrate.adjust.problem import Free, Problem, State

#: Share of the largest eigenvalue (of the equations scaled to unit diagonal) below which a direction is undetermined.
RANK_SHARE = 1e-13


@dataclass(frozen=True)
class Equations:
    """Normal equations of the parameters (c) and of each view's place (b), before the elimination.

    Parameters
    ----------
    cc : ndarray (V, C, C)
        Information of each view about the parameters.
    cb : ndarray (V, C, 6)
        Coupling with the view's place.
    bb : ndarray (V, 6, 6)
        Information about the place.
    gc, gb : ndarray (V, C), (V, 6)
        Weighted residuals times derivatives: the right-hand sides.
    prior, prior_g : ndarray (C, C), (C,)
        The same of the pseudo-observations.
    cost : float
        Weighted sum of squares.
    """

    cc: Array
    cb: Array
    bb: Array
    gc: Array
    gb: Array
    prior: Array
    prior_g: Array
    cost: float

    def reduced(self) -> tuple[Array, Array]:
        """Return each view's own information about the parameters (V, C, C) and its right-hand side (V, C)."""
        back = self.cb @ inverse_places(self.bb)
        return self.cc - back @ self.cb.transpose(0, 2, 1), self.gc - (back @ self.gb[..., None])[..., 0]


def equations(
    problem: Problem, state: State, free: Free, lines: Sequence[Linear], weights: Sequence[Array]
) -> Equations:
    """Return the normal equations of linearised blocks with these weights (V, N) each."""
    V, C = len(problem.views), free.size
    full = np.zeros((V, C + PLACE + 1, C + PLACE + 1))
    for line, weight in zip(lines, weights, strict=True):
        R, c = len(line.rows), line.jacobian.shape[-1]
        root = np.sqrt(weight[line.rows])[..., None]
        whole = np.concatenate([line.jacobian * root[..., None], (line.residual_px * root)[..., None]], -1)
        whole = whole.reshape(R, 2 * weight.shape[1], c + 1)
        at = np.r_[line.columns, np.arange(C, C + PLACE + 1)]
        full[np.ix_(line.rows, at, at)] += whole.transpose(0, 2, 1) @ whole
    prior, prior_g, cost = np.zeros((C, C)), np.zeros(C), float(full[:, -1, -1].sum())
    for item in problem.pseudo:
        if item.device in free.places:
            row, residual = item.row(free), item.residual(state.devices[item.device])
            prior += np.outer(row, row) / item.sigma**2
            prior_g += row * residual / item.sigma**2
            cost += (residual / item.sigma) ** 2
    b = slice(C, C + PLACE)
    return Equations(
        full[:, :C, :C], full[:, :C, b], full[:, b, b], full[:, :C, -1], full[:, b, -1], prior, prior_g, cost
    )


def inverse_places(bb: Array) -> Array:
    """Return the inverses (V, 6, 6); zeros for views without any observation."""
    diagonal = np.einsum("vii->vi", bb)
    empty = ~(diagonal > 0).all(1)
    scale = np.where(empty[:, None], 1.0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    scaled = bb * scale[:, :, None] * scale[:, None]
    scaled[empty] = np.eye(PLACE)
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None]
    inverse[empty] = 0.0
    return np.asarray(inverse, np.float64)


def solve(item: Equations, damping: float = 0.0) -> tuple[Array, Array]:
    """Return the step of the parameters (C,) and of the places (V, 6); damped by Levenberg and Marquardt."""
    C, V = item.prior_g.size, len(item.bb)
    bb = item.bb + damping * np.einsum("vii->vi", item.bb)[:, :, None] * np.eye(PLACE)
    inverse = inverse_places(bb)
    change = np.zeros(C)
    if C:
        S = (item.cc.sum(0) + item.prior) * (1 + damping * np.eye(C))
        S = S - np.einsum("vij,vjk,vlk->il", item.cb, inverse, item.cb, optimize=True)
        g = item.gc.sum(0) + item.prior_g - np.einsum("vij,vjk,vk->i", item.cb, inverse, item.gb, optimize=True)
        change = pseudo_inverse(S) @ g
    places = (inverse @ (item.gb - item.cb.transpose(0, 2, 1) @ change).reshape(V, PLACE, 1))[..., 0]
    return change, places


def pseudo_inverse(S: Array) -> Array:
    """Return the inverse of a positive semidefinite matrix (C, C), without the directions it says nothing about."""
    diagonal = np.diag(S)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(S * scale[:, None] * scale)
    used = values > RANK_SHARE * max(values.max(initial=0.0), 1e-300)
    scaled = vectors[:, used] * scale[:, None]
    return (scaled / values[used]) @ scaled.T
