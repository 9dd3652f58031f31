"""How far the levels of a capture disagree without any inter-reflection: what noise and harmonics explain.

Light that reaches a point over another one shifts long periods more than short ones: the second way starts far off, and
short fringes cancel over the area that it comes from. But a gamma shifts them too, each by a function of its own phase
that repeats N times a period (harmonics m N +- 1 of the wave appear as the first one, at m N times its phase). That
function, and what else the bulk of the pixels disagrees by, is measured in the capture itself; only pixels that
disagree far more are suspected.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from planish import _core
from planish.measurement import Map
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import AxisCode
from planish.sensing.capture.unwrapping import Level

#: Rows of the image that are looked at, samples that are enough, the least that say something.
ROWS, SAMPLES, MIN_SAMPLES = 16, 6000, 500
#: Bins of the folded phase (kPhaseBins of the kernel).
BINS = 32
#: Samples beyond so many standard deviations do not count in the means.
CLIP_SIGMAS = 3.0
#: Median of a squared normal variable of unit variance.
MEDIAN_CHI_SQUARE = 0.4549
#: A shift whose root mean square is a smaller share of the noise is none: 2 % more of it at most, and time.
NEGLIGIBLE = 0.2
#: Harmonics shift smoothly. A shift that jumps by more of the finer period from bin to bin is that of a wrong sign or
#: period, and must not be explained away.
LARGEST_JUMP = 0.5
NOTHING: Map = np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class PhaseStack:
    """The phase images of one axis and what they show, as the kernels want them."""

    arguments: tuple[list[GreyImage], list[int], list[float], list[float], list[float], Map]
    height: int

    @classmethod
    def of(cls, images: Sequence[GreyImage], code: AxisCode, coarse_px: Map | None) -> Self:
        """Return the stack of the phase images (H, W), in the order of `code`."""
        angles = [angle for period in code.periods for angle in period.angles]
        return cls(
            (
                list(images),
                [len(period.images) for period in code.periods],
                [float(np.cos(angle)) for angle in angles],
                [float(np.sin(angle)) for angle in angles],
                [period.period_px for period in code.periods],
                NOTHING if coarse_px is None else coarse_px,
            ),
            images[0].shape[0],
        )


def expected_disagreement(
    stack: PhaseStack, settings: dict[str, Any], code: AxisCode, threads: int
) -> list[dict[str, Any]]:
    """Return what neighbouring levels disagree by, one entry per step of the ladder, as the kernel wants it."""
    assert code.ladder is not None
    found: list[dict[str, Any]] = []
    rows = np.unique(np.linspace(0, stack.height - 1, ROWS).astype(int)).tolist()
    for coarser, finer in itertools.pairwise(code.ladder.levels):
        maps = _core.sample_disagreement(*stack.arguments, settings | {"expected": found}, rows, threads)
        known = np.flatnonzero(np.isfinite(maps[0]))
        known = known[:: max(1, len(known) // SAMPLES)]
        difference, sigma, *cycles = (values.ravel()[known] for values in maps)
        folds = _fold(coarser, code), _fold(finer, code)
        expected: dict[str, Any] = {"coarser_fold": folds[0], "finer_fold": folds[1]}
        if len(known) < MIN_SAMPLES:
            found.append(expected | {"coarser_px": [], "finer_px": [], "variance_px2": float("inf")})
            continue
        negligible = NEGLIGIBLE * float(np.median(sigma))
        for name, phase, fold in zip(("coarser_px", "finer_px"), cycles, folds, strict=True):
            shift, difference = _explained(difference, np.float32(fold) * phase, finer.period_px, negligible)
            expected[name] = shift
        expected["variance_px2"] = _excess_variance(difference**2, sigma**2)
        found.append(expected)
    return found


def _fold(level: Level, code: AxisCode) -> int:
    """Return how often the errors by harmonics repeat in a period; those of a beat depend on several phases: 0."""
    index = level.period_index
    return 0 if index is None else len(code.periods[index].images)


def _explained(difference: Map, folded: Map, period: float, negligible: float) -> tuple[list[float], Map]:
    """Return the mean difference per bin of the folded phase (nothing if negligible), and what it leaves over.

    Differences are known up to whole periods of the finer level: the mean begins as a circular one.
    """
    turns = folded - np.rint(folded) + np.float32(0.5)
    bins = (turns * BINS).astype(np.intp) & (BINS - 1)
    angle = difference * np.float32(2 * np.pi / period)
    sums = np.bincount(bins, np.cos(angle), BINS) + 1j * np.bincount(bins, np.sin(angle), BINS)
    # Bins without samples take what the rest has.
    sums[sums == 0] = sums.sum()
    mean = (np.angle(sums) * period / (2 * np.pi)).astype(np.float32)
    for _ in range(2):
        rest = _wrapped(difference - mean[bins], period)
        kept = (np.abs(rest) <= CLIP_SIGMAS * 1.4826 * np.median(np.abs(rest))).astype(float)
        count = np.bincount(bins, kept, BINS)
        mean += (np.bincount(bins, kept * rest, BINS) / np.maximum(count, 1)).astype(np.float32)
    if np.sqrt(np.mean(mean**2)) < negligible or np.abs(np.diff(mean, append=mean[:1])).max() > LARGEST_JUMP * period:
        return [], _wrapped(difference, period)
    shift = np.interp(turns, (np.arange(BINS) + 0.5) / BINS, mean, period=1).astype(np.float32)
    return mean.tolist(), _wrapped(difference - shift, period)


def _wrapped(values: Map, period: float) -> Map:
    return values - np.float32(period) * np.rint(values / np.float32(period))


def _excess_variance(squares: Map, variance: Map) -> float:
    """Return the variance that must be added for the median of squares / variance to be that of a normal variable."""

    def too_small(added: float) -> bool:
        below = np.count_nonzero(squares <= MEDIAN_CHI_SQUARE * (variance + np.float32(added)))
        return 2 * int(below) < len(squares)

    if not too_small(0.0):
        return 0.0
    low, high = 0.0, float(np.median(squares)) / MEDIAN_CHI_SQUARE
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if too_small(middle) else (low, middle)
    return high
