"""How well views fit that took no part: one after the other is left out, and only its place is fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from planish.geometry import Array
from planish.sensing.calibrate.adjust.equations import inverse_places, pseudo_inverse
from planish.sensing.calibrate.adjust.lens_models import FEW_VIEWS
from planish.sensing.calibrate.adjust.problem import Free, Problem
from planish.sensing.calibrate.adjust.robust import Adjusted
from planish.sensing.calibrate.adjust.solve import Solution, fixed, least_squares
from planish.sensing.calibrate.observations import Index

#: Directions in which a view says less about the parameters than this share of its best one do not count.
VIEW_RANK_SHARE = 1e-9


@dataclass(frozen=True)
class LeftOut:
    """Views seen by an adjustment without them.

    Parameters
    ----------
    squares : mapping of ndarray (V,)
        Per device, sum of the squared lengths of the residuals [px^2].
    counts : mapping of ndarray (V,)
        Number of points.
    """

    squares: Mapping[str, Array]
    counts: Mapping[str, Array]

    def mean_square(self, device: str) -> Array:
        """Return the mean square of the views (n,) that the device sees [px^2]."""
        seen = self.counts[device] > 0
        return self.squares[device][seen] / self.counts[device][seen]

    def rms_px(self, device: str) -> float:
        """Return the rms (2-D) over all points [px]."""
        return float(np.sqrt(self.squares[device].sum() / max(self.counts[device].sum(), 1)))


def leave_out(item: Adjusted) -> LeftOut:
    """Return how each view fits an adjustment without it.

    With few views each adjustment is done again; with more, one Gauss-Newton step away from the full adjustment says
    the same, because one view in many changes little.
    """
    problem, solution = item.problem, item.solution
    views = np.flatnonzero(problem.covered)
    residuals = [np.zeros_like(block.observed_px) for block in problem.blocks]
    if len(views) < FEW_VIEWS:
        for v in views:
            for whole, line in zip(residuals, _refit(item, int(v)).lines, strict=True):
                at = line.rows == v
                whole[v] = line.residual_px[at][0] if at.any() else 0.0
    else:
        change = leave_out_steps(solution)
        for whole, line in zip(residuals, solution.lines, strict=True):
            whole[line.rows] = _predicted(solution, line.jacobian, line.rows, line.columns, line.residual_px, change)
    squares = {name: np.zeros(len(problem.views)) for name in problem.devices}
    counts = {name: np.zeros(len(problem.views)) for name in problem.devices}
    for block, whole, outlier in zip(problem.blocks, residuals, item.outlier, strict=True):
        kept = block.seen & ~outlier
        squares[block.device] += np.where(kept, (whole**2).sum(-1), 0.0).sum(1)
        counts[block.device] += kept.sum(1)
    return LeftOut(squares, counts)


def leave_out_steps(solution: Solution) -> Array:
    """Return how the parameters (V, C) change when each view is left out, to first order."""
    S, g = solution.equations.reduced()
    rest = S.sum(0) + solution.equations.prior - S
    return np.array([-pseudo_inverse(matrix) @ vector for matrix, vector in zip(rest, g, strict=True)])


def covariance_factor(solution: Solution) -> tuple[float, int]:
    """Return how much farther left-out views are off than the covariance says (chi-square / dof), and the dof.

    Notes
    -----
    What a view says about the parameters is g, with covariance S under noise. Seen from an adjustment without it, whose
    covariance is R^-1, it is (I + S R^-1) g with covariance S + S R^-1 S; its chi-square is g' (S^-1 + R^-1) g.
    """
    S, g = solution.equations.reduced()
    total = S.sum(0) + solution.equations.prior
    chi, count = 0.0, 0
    scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    for matrix, vector in zip(S, g, strict=True):
        values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale)
        used = values > VIEW_RANK_SHARE * max(values.max(initial=0.0), 1e-300)
        along = vectors[:, used].T @ (scale * vector)
        own = vectors[:, used] @ along / scale
        chi += float((along**2 / values[used]).sum() + own @ pseudo_inverse(total - matrix) @ own)
        count += int(used.sum())
    return chi / max(count, 1), count


def _predicted(
    solution: Solution, jacobian: Array, rows: Index, columns: Index, residual: Array, change: Array
) -> Array:
    whole = solution.equations
    places = (
        inverse_places(whole.bb) @ (whole.gb - (whole.cb.transpose(0, 2, 1) @ change[..., None])[..., 0])[..., None]
    )[..., 0]
    step = np.concatenate([change[np.ix_(rows, columns)], places[rows]], axis=1)
    return residual - (jacobian @ step[:, None, :, None])[..., 0]


def _refit(item: Adjusted, view: int) -> Solution:
    """Adjustment without one view, then the view's place alone."""
    problem, only = item.problem, np.arange(len(item.problem.views)) == view
    without = fixed([np.where(only[:, None], 0.0, weight) for weight in item.solution.weights])
    rest = least_squares(problem, item.state, item.free, without)
    nothing = Free(dict.fromkeys(item.free.places, ()))
    weights = fixed([np.where(only[:, None], weight, 0.0) for weight in item.solution.weights])
    if item.free.modes:
        problem = shaped(problem, rest.state.amplitudes)
    return least_squares(replace(problem.only(only), pseudo=()), rest.state, nothing, weights)


def shaped(problem: Problem, amplitudes: Array) -> Problem:
    """Return the problem with the shape of its board as points."""
    return replace(problem, points_board=problem.points_board + np.tensordot(amplitudes, problem.modes, 1))
