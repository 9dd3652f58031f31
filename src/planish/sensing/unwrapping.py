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

#: Largest coefficient of a level, by the number of periods; more of them make the candidates too many.
LARGEST_COEFFICIENT = {1: 1, 2: 12, 3: 4, 4: 2}
#: With still more periods, a level is made of so many of them at most.
MOST_COMBINED = 3
#: Standard deviations that half a period must hold: beyond, one pixel in 100,000 slips.
SLIP_SIGMAS = 4.5
#: Noise over amplitude of the best images there are: half of a full well of 20,000 electrons, full contrast.
BEST_NOISE = 0.01
#: A period takes part in the mean where it brings this share of the information of the best one.
MIN_SHARE = 0.1
#: Chance of a slip that one more level with a coefficient more is worth.
SIMPLICITY = 1e-9
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
        Projector pixels to be told apart; None: as far as the longest period, or the beat of neighbouring ones, reaches.
    cell_px : float or None
        Length of a Gray cell, where there is a Gray code: then the first level need only be as long.

    Notes
    -----
    Going from level c to level f, the whole periods are round((x_c - x_f) / P_f); both depend on the same phases, so
    that the variance of the difference is sum (P_c c_i - P_f f_i)^2 var_i / (2 pi)^2, var_i = 2 / N_i (noise/amplitude)^2.
    The chance of a slip is that of half a period, at the noise where the hardest step of the best ladder is at its
    limit; the ladder with the smallest sum over its steps is a shortest path. Compare Towers, Judge and Jones, "Absolute
    fringe metrology using heterodyne" (Optics Letters 28, 2003) and Petkovic et al. on tolerances of such steps.
    """
    variances = [2.0 / n for n in steps]
    finest = min(range(len(steps)), key=lambda i: variances[i] * periods_px[i] ** 2)
    last = Level(tuple(int(i == finest) for i in range(len(steps))), periods_px[finest])
    if cell_px is None:
        reach = extent_px if extent_px is not None else _natural_reach(periods_px)
    else:
        reach = cell_px
    levels = [level for level in candidates(periods_px) if level.period_px > last.period_px * (1 + ROUNDING)] + [last]
    starts = [level for level in levels if level.period_px >= reach * (1 - ROUNDING)]
    if cell_px is not None and len(wide := [level for level in starts if level.period_px >= 2 * cell_px]) > 0:
        starts = wide  # Half a cell is then a quarter of a period at most: a wrong bit beside a border does no harm.
    if not starts:
        return None
    best = _widest(levels, starts, last, variances)
    path = _safest(levels, starts, last, variances, best / SLIP_SIGMAS)
    informative = [
        i for i in range(len(steps)) if variances[finest] * last.period_px**2 >= MIN_SHARE * variances[i] * periods_px[i] ** 2
    ]
    return Ladder(tuple(path), tuple(informative), best / SLIP_SIGMAS)


def candidates(periods_px: Sequence[float]) -> list[Level]:
    """Return the levels that can be made of some periods, from the longest to the shortest; of equal ones the simplest."""
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


def _half_period_in_sigmas(coarse: Level, fine: Level, variances: Sequence[float]) -> float:
    """Return half a period of the finer level over the standard deviation of the step, at noise = amplitude."""
    square = sum(
        (coarse.period_px * c - fine.period_px * f) ** 2 * variance
        for c, f, variance in zip(coarse.coefficients, fine.coefficients, variances, strict=True)
    )
    return 0.5 * fine.period_px * 2 * math.pi / math.sqrt(square)


def _widest(levels: Sequence[Level], starts: Sequence[Level], last: Level, variances: Sequence[float]) -> float:
    """Return the hardest step of the ladder whose hardest step is the easiest."""
    best = {level: math.inf if level in starts else 0.0 for level in levels}
    for i, fine in enumerate(levels):
        for coarse in levels[:i]:
            if best[coarse] > best[fine] and coarse.period_px > fine.period_px * (1 + ROUNDING):
                best[fine] = max(best[fine], min(best[coarse], _half_period_in_sigmas(coarse, fine, variances)))
    return best[last]


def _safest(
    levels: Sequence[Level], starts: Sequence[Level], last: Level, variances: Sequence[float], noise: float
) -> list[Level]:
    """Return the ladder with the smallest sum of the chances of a slip, the simplest of those that are equal."""
    cost = {level: _complexity(level) if level in starts else math.inf for level in levels}
    before: dict[Level, Level] = {}
    for i, fine in enumerate(levels):
        for coarse in levels[:i]:
            if cost[coarse] >= cost[fine] or coarse.period_px <= fine.period_px * (1 + ROUNDING):
                continue
            sigmas = _half_period_in_sigmas(coarse, fine, variances) / noise if math.isfinite(noise) else math.inf
            through = cost[coarse] + math.erfc(sigmas / math.sqrt(2)) + _complexity(fine)
            if through < cost[fine]:
                cost[fine], before[fine] = through, coarse
    path = [last]
    while path[0] in before:
        path.insert(0, before[path[0]])
    return path


def _complexity(level: Level) -> float:
    return SIMPLICITY * sum(abs(a) for a in level.coefficients)
