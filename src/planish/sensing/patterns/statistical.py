"""Statistical patterns: brightness profiles that tell every place of a projector apart by its course over the images.

Each image is a cosine of full contrast whose frequency wanders: brightness = 1/2 + 1/2 cos(theta(x)). The slope of
theta stays below 2 pi / min_period_px. Aperiodic sinusoidal fringes (Heist, Luetzelschwab, Dietrich, Kuehmstedt,
Notni, Optical Engineering 53(11), 2014) have more contrast than sums of cosines: every pixel sees half light to full
light in almost every image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planish.errors import InputError
from planish.geometry import Array

#: Frequency of a profile, in units of 1 / min_period_px: the mean of all images, half the range over which images
#: differ, and how far one wanders along the projector. They add up to 1: no period is shorter than min_period_px.
#: Found by measuring, 10 to 16 images on 1280 px: more spread costs slope (accuracy), less lets places look alike.
MEAN_FREQUENCY, IMAGE_SPREAD, WANDER = 0.70, 0.15, 0.15
#: The frequency wanders by a sum of so many cosines, whose periods go from SHORTEST to LONGEST min_period_px.
WANDER_TERMS, SHORTEST, LONGEST = 6, 6.0, 60.0


def statistical_profile(coordinate_px: ArrayLike, index: int, seed: int = 1, min_period_px: float = 12.0) -> Array:
    """Return the brightness (...,), 0 to 1, of statistical pattern `index` at projector coordinates (...,) [px].

    The profile is a smooth function of the coordinate, the same for ever for the same index, seed and period. Profiles
    of different index or seed are uncorrelated.

    Parameters
    ----------
    coordinate_px : array_like (...,)
        Coordinates along the axis of the pattern [px], whole or not.
    index : int
        Number of the image, >= 0.
    seed : int
        Of the whole sequence, >= 0.
    min_period_px : float
        No period is shorter [px].

    Raises
    ------
    InputError
        Where index or seed is negative or the period not positive.

    Notes
    -----
    theta = 2 pi (f x + sum_m c Q_m / (2 pi) sin(2 pi x / Q_m + a_m)) + a_0; its slope / 2 pi is f + sum_m c cos(...).
    """
    if index < 0 or seed < 0:
        raise InputError("index, seed", f"found {index}, {seed}", "whole numbers >= 0")
    if not 0 < min_period_px < np.inf:
        raise InputError("min_period_px", f"found {min_period_px}", "a period above 0 px")
    x = np.asarray(coordinate_px, float) / min_period_px
    random = _uniform(seed, index, 2 * WANDER_TERMS + 2)
    place, phase = random[:WANDER_TERMS], 2 * np.pi * random[WANDER_TERMS : 2 * WANDER_TERMS]
    frequency = MEAN_FREQUENCY + IMAGE_SPREAD * (2 * random[-2] - 1)
    theta = 2 * np.pi * (frequency * x + random[-1])
    # One period from each of equal intervals of log period.
    periods = SHORTEST * (LONGEST / SHORTEST) ** ((np.arange(WANDER_TERMS) + place) / WANDER_TERMS)
    for period, start in zip(periods, phase, strict=True):
        theta = theta + WANDER / WANDER_TERMS * period * np.sin(2 * np.pi * x / period + start)
    return np.asarray(0.5 + 0.5 * np.cos(theta))


def _uniform(seed: int, index: int, count: int) -> NDArray[np.float64]:
    # The raw output of Philox is fixed by its definition (Salmon et al. 2011); NumPy's distributions are not.
    raw = np.random.Philox(key=[seed, index]).random_raw(count)
    return np.asarray((raw >> np.uint64(11)).astype(float) * 2.0**-53)
