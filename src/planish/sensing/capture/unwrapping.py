"""From coarse to fine: the ladder of levels by which fringes of several periods tell their whole periods.

A level is the phase sum a_i phi_i of whole multiples of the periods' phases. It repeats every P = 1 / sum(a_i / P_i): a
single period is a level, and so is the beat of two (1/P = 1/P_1 - 1/P_2) or the beat of beats. Noise grows with it:
sigma = P / (2 pi) sqrt(sum a_i^2 var_i).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

Array = NDArray[np.float64]

#: Largest coefficient of a level, by the number of periods; more of them make the candidates too many.
LARGEST_COEFFICIENT = {1: 1, 2: 12, 3: 4}
#: With more periods, a level is made of so many of them at most, with coefficients up to 2: beats, and beats of beats.
MOST_COMBINED = 3
#: Standard deviations that half a period must hold: beyond, one pixel in 100,000 slips.
SLIP_SIGMAS = 4.5
#: Noise over amplitude of the best images there are: half of a full well of 20,000 electrons, full contrast.
BEST_NOISE = 0.01
#: A period takes part in the mean where it brings this share of the information of the best one.
MIN_SHARE = 0.1
#: Chance of a slip that a ladder may be worse by for one level, or one in a coefficient, less.
SIMPLICITY = 1e-6
#: Cells that may be missing before a level is too short for the projector (rounded periods).
ROUNDING = 1e-6


@dataclass(frozen=True)
class Level:
    """The phase sum of `coefficients` (one per period) times the phases, which repeats every `period_px`."""

    coefficients: tuple[int, ...]
    period_px: float

    @property
    def period_index(self) -> int | None:
        """Index of the period that this level is; None for a beat."""
        used = [i for i, a in enumerate(self.coefficients) if a]
        return used[0] if len(used) == 1 and self.coefficients[used[0]] == 1 else None

    def __str__(self) -> str:
        """Return it in words."""
        return f"{self.period_px:g} px" if self.period_index is not None else f"the beat of {self.period_px:g} px"


@dataclass(frozen=True)
class Ladder:
    """How an axis is unwrapped.

    Parameters
    ----------
    levels : tuple of Level
        From the absolute one (or the first above the Gray cells) to the finest, which is a single period.
    averaged : tuple of int
        Indices of the periods whose weighted mean is the position: all that are nearly as fine as the finest.
    noise_limit : float
        Noise over amplitude at which the hardest step still holds SLIP_SIGMAS.
    """

    levels: tuple[Level, ...]
    averaged: tuple[int, ...]
    noise_limit: float


def plan_levels(
    periods_px: Sequence[float], steps: Sequence[int], extent_px: float | None = None, cell_px: float | None = None
) -> Ladder | None:
    """Return the ladder with the smallest chance of a slip; None where no level reaches over the projector.

    Parameters
    ----------
    periods_px, steps : sequence
        Period and number of phase steps of each.
    extent_px : float or None
        Projector pixels to be told apart; None: as far as the longest period, or the beat of neighbours, reaches.
    cell_px : float or None
        Length of a Gray cell, where there is a Gray code: then the first level need only be as long.

    Notes
    -----
    Going from level c to level f, the whole periods are round((x_c - x_f) / P_f); both depend on the same phases, so
    that the variance of the difference is sum (P_c c_i - P_f f_i)^2 var_i / (2 pi)^2 with
    var_i = 2 / N_i (noise / amplitude)^2. The chance of a slip is that of half a period, at the noise where the hardest
    step of the best ladder is at its limit; the ladder with the smallest sum over its steps is a shortest path. Beats:
    Towers, Towers and Jones, "Optimum frequency selection in multifrequency interferometry", Optics Letters 28, 2003.
    """
    variances = [2.0 / n for n in steps]
    finest = min(range(len(steps)), key=lambda i: variances[i] * periods_px[i] ** 2)
    last = Level(tuple(int(i == finest) for i in range(len(steps))), periods_px[finest])
    if cell_px is None:
        reach = extent_px if extent_px is not None else _natural_reach(periods_px)
    else:
        reach = cell_px
    levels = [level for level in candidates(periods_px) if level.period_px > last.period_px * (1 + ROUNDING)] + [last]
    lengths = np.array([level.period_px for level in levels])
    starts = lengths >= reach * (1 - ROUNDING)
    if cell_px is not None and (wide := lengths >= 2 * cell_px).any():
        starts = wide  # Half a cell is then a quarter of a period at most: a wrong bit beside a border does no harm.
    if not starts.any():
        return None
    easiness = _half_periods_in_sigmas(levels, variances)
    path = [len(levels) - 1]
    if not starts[-1]:
        path = _safest(levels, easiness, starts, _hardest_step(easiness, starts) / SLIP_SIGMAS)
    limit = min((easiness[c, f] for c, f in itertools.pairwise(path)), default=math.inf) / SLIP_SIGMAS
    share = variances[finest] * last.period_px**2 / (np.array(variances) * np.array(periods_px) ** 2)
    return Ladder(tuple(levels[i] for i in path), tuple(np.flatnonzero(share >= MIN_SHARE).tolist()), float(limit))


def candidates(periods_px: Sequence[float]) -> list[Level]:
    """Return the levels that periods can make, from the longest to the shortest; of equal ones the simplest."""
    found: dict[float, Level] = {}
    for coefficients in sorted(_coefficients(len(periods_px)), key=lambda c: (sum(map(abs, c)), c)):
        frequency = sum(a / p for a, p in zip(coefficients, periods_px, strict=True))
        # A multiple of another sum knows nothing that that does not; what is but rounding of the periods has no period.
        if math.gcd(*coefficients) == 1 and frequency * max(periods_px) > 1e-9:
            found.setdefault(round(math.log(frequency), 9), Level(coefficients, 1 / frequency))
    return sorted(found.values(), key=lambda level: -level.period_px)


def _coefficients(count: int) -> Iterator[tuple[int, ...]]:
    largest = LARGEST_COEFFICIENT.get(count, 2)
    if count <= max(LARGEST_COEFFICIENT):
        yield from itertools.product(range(-largest, largest + 1), repeat=count)
        return
    for members in itertools.combinations(range(count), MOST_COMBINED):
        for values in itertools.product(range(-largest, largest + 1), repeat=MOST_COMBINED):
            full = [0] * count
            for i, value in zip(members, values, strict=True):
                full[i] = value
            yield tuple(full)


def _natural_reach(periods_px: Sequence[float]) -> float:
    """Return the longest period, or beat of neighbours, or beat of their beats."""
    frequencies = sorted(1 / p for p in periods_px)
    reach = max(periods_px)
    while len(frequencies) > 1:
        frequencies = sorted(abs(b - a) for a, b in itertools.pairwise(frequencies))
        frequencies = [f for f in frequencies if f * reach > ROUNDING]
        reach = max([reach, *(1 / f for f in frequencies)])
    return reach


def _half_periods_in_sigmas(levels: Sequence[Level], variances: Sequence[float]) -> Array:
    """Return half a period of level f over the standard deviation of the step from c (c, f), at noise = amplitude."""
    # Position of a level by period: P a_i phi_i / (2 pi).
    gains = np.array([level.period_px / (2 * np.pi) * np.array(level.coefficients, float) for level in levels])
    periods = np.array([level.period_px for level in levels])
    square = sum(v * (g[:, None] - g[None, :]) ** 2 for v, g in zip(variances, gains.T, strict=True))
    longer = periods[:, None] > periods[None, :] * (1 + ROUNDING)
    return np.where(longer, 0.5 * periods / np.sqrt(np.where(longer, square, 1.0)), 0.0)


def _hardest_step(easiness: Array, starts: NDArray[np.bool_]) -> float:
    """Return the easiness of the hardest step of that ladder to the last level whose hardest step is the easiest."""
    best = np.where(starts, np.inf, 0.0)
    for fine in range(1, len(best)):
        best[fine] = max(best[fine], np.minimum(best[:fine], easiness[:fine, fine]).max())
    return float(best[-1])


def _safest(levels: Sequence[Level], easiness: Array, starts: NDArray[np.bool_], noise: float) -> list[int]:
    """Return the ladder with the smallest sum of the chances of a slip, the simplest of those that are about equal."""
    price = SIMPLICITY * np.array([sum(map(abs, level.coefficients)) for level in levels])
    chance = erfc(easiness / (noise * np.sqrt(2))) + price
    chance[easiness == 0] = np.inf
    cost, before = np.where(starts, price, np.inf), np.full(len(levels), -1)
    for fine in range(1, len(levels)):
        through = cost[:fine] + chance[:fine, fine]
        coarse = int(np.argmin(through))
        if through[coarse] < cost[fine]:
            cost[fine], before[fine] = through[coarse], coarse
    path = [len(levels) - 1]
    while before[path[0]] >= 0:
        path.insert(0, int(before[path[0]]))
    return path
