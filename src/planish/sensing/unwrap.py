"""Whole periods where fringes are no cosine: each coarser position is corrected before it counts finer periods."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from planish.measurement import Map, NoiseModel, rejection_bit
from planish.sensing.decode import DecodeOptions, PhaseMap, decode
from planish.sensing.gamma import WaveError, estimate_wave_error, without_wave_error
from planish.sensing.images import GreyImage
from planish.sensing.sequence import AxisCode, GrayCode

#: More steps make no error of the phase that could cost a period (with gamma 3, N = 5: 0.003 rad).
MAX_STEPS = 4
#: Image lines that serve to find out, in either direction.
LINES = 24
#: Errors of the coarser position from which it is corrected, in finer periods; a quarter of one is rejected.
MIN_ERROR_PERIODS = 0.1
#: Both periods' noise that makes a slip, in finer periods: half a one at 4.5 standard deviations (as in the kernel).
MAX_SIGMA_PERIODS = 0.5 / 4.5


def decode_unwrapped(
    images: Sequence[GreyImage],
    code: AxisCode,
    noise: NoiseModel,
    saturation: float,
    options: DecodeOptions,
    threads: int,
    coarse_px: Map | None = None,
) -> tuple[PhaseMap, Map, Map]:
    """Return what `decode` returns; of fringes that are no cosine, with whole periods from corrected coarser positions.

    The finest phase itself is not corrected: between two cameras its error cancels (sensing/gamma.py).

    Notes
    -----
    The error of a phase [rad] is the same for every period of as many steps; in pixels it grows with the period, and a
    coarser period's error e P_coarse / (2 pi) may reach the quarter of a finer period that is allowed.
    """
    error = _endangering_error(images, code, noise, saturation, options, threads)
    if error is None:
        return decode(images, code, noise, saturation, options, threads, coarse_px)
    position: Map | None = None
    coarse: PhaseMap | None = None
    means, modulations, rejected = [], [], None
    for period in code.periods:
        # A Gray code of cells without length: the limit is then a quarter of the period, as between periods.
        gray = None if coarse is None else GrayCode(0.0, (), ())
        level = replace(code, periods=(period,), gray=gray)
        phase, mean, modulation = decode(images, level, noise, saturation, options, threads, position)
        if coarse is not None:
            with np.errstate(invalid="ignore"):
                noisy = np.hypot(coarse.sigma_px, phase.sigma_px) > MAX_SIGMA_PERIODS * period.period_px
            phase = phase.without(noisy, "slip")
        rejected = phase.rejected if rejected is None else rejected | phase.rejected
        means.append(mean)
        modulations.append(modulation)
        fits = len(period.images) == error.steps
        coarse = without_wave_error(phase, error, period.period_px) if fits else phase
        position = coarse.position_px
    assert rejected is not None
    # A slip of a coarser period that a finer one's neighbours mended is none.
    mended = np.isfinite(phase.position_px)
    rejected = np.where(mended, rejected & ~rejection_bit("slip"), rejected)
    # The precise position decides on which side of the longest period's seam it lies.
    longest = code.periods[0].period_px
    start = -0.5 - (0.5 * (longest - code.extent_px) if code.extent_px is not None else 0.0)
    place = phase.position_px
    with np.errstate(invalid="ignore"):
        turns = np.floor((place - np.float32(start)) / np.float32(longest)).astype(np.float32)
    weights = [len(period.images) for period in code.periods]
    mean, modulation = (np.average(maps, axis=0, weights=weights).astype(np.float32) for maps in (means, modulations))
    return replace(phase, position_px=place - np.float32(longest) * turns, rejected=rejected), mean, modulation


def _endangering_error(
    images: Sequence[GreyImage],
    code: AxisCode,
    noise: NoiseModel,
    saturation: float,
    options: DecodeOptions,
    threads: int,
) -> WaveError | None:
    periods = code.periods
    nested = len(periods) > 1 and code.gray is None
    if not nested or (code.extent_px is not None and periods[0].period_px < code.extent_px):
        return None
    finest = periods[-1]
    if len(finest.images) > MAX_STEPS:
        return None
    ratio = max(a.period_px / b.period_px for a, b in itertools.pairwise(periods))
    alone = replace(code, periods=(finest,), extent_px=None)
    height, width = images[0].shape
    steepest: tuple[float, WaveError] | None = None
    for lines in (np.s_[:: max(1, height // LINES)], np.s_[:, :: max(1, width // LINES)]):
        sample: list[Any] = list(images)
        for index in finest.images:
            sample[index] = np.ascontiguousarray(images[index][lines])
        phase = decode(sample, alone, noise, saturation, options, threads)[0]
        found = estimate_wave_error(phase, finest.period_px, len(finest.images), LINES)
        if found is not None and found.significant and (steepest is None or found.amplitude_rad > steepest[0]):
            steepest = (found.amplitude_rad, found)
    if steepest is None or steepest[0] * ratio / (2 * np.pi) < MIN_ERROR_PERIODS:
        return None
    return steepest[1]
