"""Least squares by Levenberg and Marquardt, with fixed or robust weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from planish.geometry import Array
from planish.sensing.calibrate.adjust.equations import Equations, equations, solve
from planish.sensing.calibrate.adjust.linear import Linear, linearise, moved
from planish.sensing.calibrate.adjust.problem import Free, Problem, State

#: First damping, its factor after a step that failed or succeeded, and where to give up.
DAMPING, WORSE, BETTER, MOST_DAMPING = 1e-4, 10.0, 0.1, 1e8
#: A step is the last one when it lowers the cost by less than this share and less than SMALL_DROP in itself.
SMALL_SHARE, SMALL_DROP = 1e-9, 1e-4
#: Steps are few near the solution; more are wanted by bad starts only.
MAX_STEPS = 60

#: Weights (V, N) per block, from the linearised blocks.
Weights = Callable[[Sequence[Linear]], list[Array]]


@dataclass(frozen=True)
class Solution:
    """Where the adjustment ended.

    Parameters
    ----------
    state : State
        The values.
    lines : list of Linear
        Residuals and derivatives there, per block.
    weights : list of ndarray (V, N)
        Weights there.
    equations : Equations
        Normal equations there.
    """

    state: State
    lines: list[Linear]
    weights: list[Array]
    equations: Equations


def least_squares(problem: Problem, state: State, free: Free, weigh: Weights, steps: int = MAX_STEPS) -> Solution:
    """Return the state of least weighted squares.

    Robust weights are those of the residuals before a step: iteratively reweighted least squares.
    """
    lines = [linearise(problem, state, free, block) for block in problem.blocks]
    damping = DAMPING
    for _ in range(steps):
        weights = weigh(lines)
        now = equations(problem, state, free, lines, weights)
        while damping < MOST_DAMPING:
            change, places = solve(now, damping)
            ahead = moved(problem, state, free, change, places)
            ahead_lines = [linearise(problem, ahead, free, block) for block in problem.blocks]
            cost = _cost(problem, ahead, ahead_lines, weights)
            if cost <= now.cost:
                break
            damping *= WORSE
        else:
            break
        state, lines, damping = ahead, ahead_lines, max(damping * BETTER, 1e-12)
        if now.cost - cost <= SMALL_DROP + SMALL_SHARE * now.cost:
            break
    weights = weigh(lines)
    return Solution(state, lines, weights, equations(problem, state, free, lines, weights))


def fixed(weights: Sequence[Array]) -> Weights:
    """Return weights that do not depend on the residuals."""
    kept = list(weights)
    return lambda lines: kept


def _cost(problem: Problem, state: State, lines: Sequence[Linear], weights: Sequence[Array]) -> float:
    total = sum(
        float((line.residual_px**2 * weight[line.rows][..., None]).sum())
        for line, weight in zip(lines, weights, strict=True)
    )
    for item in problem.pseudo:
        if item.device in state.devices:
            total += (item.residual(state.devices[item.device]) / item.sigma) ** 2
    return total if np.isfinite(total) else np.inf
