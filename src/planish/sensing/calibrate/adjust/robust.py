"""The robust adjustment: a start that outliers do not pull, named outliers, noise of each device, covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from planish.geometry import Array
from planish.sensing.calibrate.adjust.equations import equations, inverse_places, pseudo_inverse
from planish.sensing.calibrate.adjust.linear import Linear, linearise
from planish.sensing.calibrate.adjust.problem import Block, Free, Mask, Problem, State
from planish.sensing.calibrate.adjust.solve import Solution, Weights, fixed, least_squares

#: Cauchy's constant for the length of a residual in standard deviations of one coordinate (95 % efficiency: 2.4 to 3).
CAUCHY = 3.0
#: Median length of a residual of two coordinates with unit variance: root of 2 ln 2.
MEDIAN_LENGTH = float(np.sqrt(2 * np.log(2)))
#: Noise of detection is never taken as smaller than this [px]: images without noise exist in simulations only.
LEAST_NOISE_PX = 1e-4
#: An image with a larger share of outliers is no image of this board at this place.
BAD_SHARE = 0.4
#: Fewer points do not hold a place of the board and tell of the lens as well.
LEAST_KEPT = 6
#: Rounds of outlier search and noise estimate; a change of noise below SETTLED ends them.
ROUNDS, SETTLED = 8, 0.002


@dataclass(frozen=True)
class Adjusted:
    """An adjustment with what it found out about its observations.

    Parameters
    ----------
    problem : Problem
        Without the images in `dropped`.
    free : Free
        What was adjusted.
    solution : Solution
        Values, residuals, equations.
    outlier : tuple of ndarray (V, N)
        Per block, seen points that do not count.
    noise : mapping of float
        Per device, factor on the stated sigma.
    dropped : tuple of (int, int)
        Block and view of images that were left out as a whole.
    """

    problem: Problem
    free: Free
    solution: Solution
    outlier: tuple[Mask, ...]
    noise: Mapping[str, float]
    dropped: tuple[tuple[int, int], ...]

    @property
    def state(self) -> State:
        """The adjusted values."""
        return self.solution.state

    def covariance(self) -> Array:
        """Return the covariance (C, C) of the parameters from the noise of the images alone."""
        return pseudo_inverse(self.solution.equations.reduced()[0].sum(0) + self.solution.equations.prior)


def outlier_limit(points: int, share: float) -> float:
    """Return the length of a residual [sigma] that the largest of `points` exceeds with probability `share`."""
    return float(np.sqrt(-2 * np.log(share / max(points, 1))))


def lengths(block: Block, line: Linear) -> Array:
    """Return residual lengths over the stated sigma (V, N); NaN where not seen."""
    out = np.full(block.sigma_px.shape, np.nan)
    seen = block.seen[line.rows]
    out[line.rows] = np.where(seen, np.linalg.norm(line.residual_px, axis=-1) / block.sigma_px[line.rows], np.nan)
    return out


def adjust_robustly(problem: Problem, state: State, free: Free, share: float = 0.05) -> Adjusted:
    """Return the adjustment of a problem from start values.

    Parameters
    ----------
    problem, state, free
        What was seen, start values, what is free.
    share : float
        Probability that a set of observations without outliers loses any.
    """
    first = least_squares(problem, state, free, _cauchy(problem))
    noise = _robust_noise(problem, first.lines)
    dropped = _bad_images(problem, first.lines, noise, share)
    for block, view in dropped:
        problem = _without(problem, block, view)
    return _final(problem, first.state, free, noise, share, dropped)


def _final(
    problem: Problem,
    state: State,
    free: Free,
    noise: Mapping[str, float],
    share: float,
    dropped: Sequence[tuple[int, int]],
) -> Adjusted:
    """Least squares on what is no outlier, in turns with the search for outliers and the estimate of the noise."""
    points = sum(int(block.seen.sum()) for block in problem.blocks)
    limit = outlier_limit(points, share)
    lines = [linearise(problem, state, free, block) for block in problem.blocks]
    outlier = _outliers(problem, lines, noise, limit)
    for _ in range(ROUNDS):
        solution = least_squares(problem, state, free, fixed(_weights(problem, noise, outlier)))
        state = solution.state
        before, noise = noise, variance_components(problem, free, solution, noise, outlier)
        found = _outliers(problem, solution.lines, noise, limit)
        same = all(np.array_equal(a, b) for a, b in zip(found, outlier, strict=True))
        outlier = found
        if same and max(abs(noise[name] / before[name] - 1) for name in noise) < SETTLED:
            break
    weights = _weights(problem, noise, outlier)
    solution = replace(solution, weights=weights, equations=equations(problem, state, free, solution.lines, weights))
    return Adjusted(problem, free, solution, tuple(outlier), noise, tuple(dropped))


def variance_components(
    problem: Problem, free: Free, solution: Solution, noise: Mapping[str, float], outlier: Sequence[Mask]
) -> dict[str, float]:
    """Return per device the factor on its stated sigma: sum of squares over the device's share of the redundancy.

    Notes
    -----
    Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, AVN 86 (1979): the redundancy of a
    group of observations is their number less the trace of N^-1 N_group.
    """
    whole = solution.equations
    inverse = inverse_places(whole.bb)
    C_cc = pseudo_inverse(whole.reduced()[0].sum(0) + whole.prior)
    back = inverse @ whole.cb.transpose(0, 2, 1)
    C_bc = -back @ C_cc
    C_bb = inverse - C_bc @ back.transpose(0, 2, 1)
    factors = {}
    for device in problem.devices:
        own = [i for i, block in enumerate(problem.blocks) if block.device == device]
        part = equations(
            replace(problem, pseudo=()), solution.state, free,
            [solution.lines[i] for i in own], [solution.weights[i] for i in own],
        )  # fmt: skip
        used = np.einsum("ij,vji->", C_cc, part.cc) + 2 * np.einsum("vij,vji->", C_bc, part.cb)
        used += np.einsum("vij,vji->", C_bb, part.bb)
        count = 2 * sum(int((problem.blocks[i].seen & ~outlier[i]).sum()) for i in own)
        factor = np.sqrt(part.cost / max(count - float(used), 1.0))
        factors[device] = max(noise[device] * factor, _least(problem, device))
    return factors


def _weights(problem: Problem, noise: Mapping[str, float], outlier: Sequence[Mask]) -> list[Array]:
    return [
        np.where(block.seen & ~out, 1 / (noise[block.device] * block.sigma_px) ** 2, 0.0)
        for block, out in zip(problem.blocks, outlier, strict=True)
    ]


def _cauchy(problem: Problem) -> Weights:
    def weigh(lines: Sequence[Linear]) -> list[Array]:
        noise = _robust_noise(problem, lines)
        weights = []
        for block, line in zip(problem.blocks, lines, strict=True):
            sigma = noise[block.device] * block.sigma_px
            d = np.nan_to_num(lengths(block, line) / noise[block.device])
            weights.append(np.where(block.seen, 1 / sigma**2 / (1 + (d / CAUCHY) ** 2), 0.0))
        return weights

    return weigh


def _robust_noise(problem: Problem, lines: Sequence[Linear]) -> dict[str, float]:
    """Per device, factor on the stated sigma by the median of the residuals' lengths."""
    noise = {}
    for device in problem.devices:
        own = [lengths(b, line) for b, line in zip(problem.blocks, lines, strict=True) if b.device == device]
        noise[device] = max(float(np.nanmedian(np.stack(own))) / MEDIAN_LENGTH, _least(problem, device))
    return noise


def _least(problem: Problem, device: str) -> float:
    sigma = np.concatenate([block.sigma_px[block.seen] for block in problem.blocks_of(device)])
    return LEAST_NOISE_PX / float(np.median(sigma))


def _outliers(problem: Problem, lines: Sequence[Linear], noise: Mapping[str, float], limit: float) -> list[Mask]:
    out = []
    for block, line in zip(problem.blocks, lines, strict=True):
        with np.errstate(invalid="ignore"):
            found = lengths(block, line) > limit * noise[block.device]
        # Where few points are left, none of them is worth anything.
        few = (block.seen & ~found).sum(1) < LEAST_KEPT
        out.append(block.seen & (found | few[:, None]))
    return out


def _bad_images(
    problem: Problem, lines: Sequence[Linear], noise: Mapping[str, float], share: float
) -> list[tuple[int, int]]:
    points = sum(int(block.seen.sum()) for block in problem.blocks)
    limit = outlier_limit(points, share)
    bad = []
    for number, outlier in enumerate(_outliers(problem, lines, noise, limit)):
        seen = problem.blocks[number].seen.sum(1)
        bad += [(number, int(v)) for v in np.flatnonzero(outlier.sum(1) > BAD_SHARE * np.maximum(seen, 1))]
    return bad


def _without(problem: Problem, block: int, view: int) -> Problem:
    mask = np.arange(len(problem.views))[:, None] == view
    blocks = list(problem.blocks)
    blocks[block] = blocks[block].without(mask)
    return replace(problem, blocks=tuple(blocks))
