"""The noise of a camera, estimated from the sequence itself.

N > 3 phase steps overdetermine A, B and phi: what they leave over is noise. Texture and light cancel in it, because
they are the same in every step. Where the fringes are no pure cosine, harmonics remain; they vary slowly along the
fringes, so the second difference between three neighbouring pixels of a column removes them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from planish.measurement import NoiseModel
from planish.sensing.images import GreyImage
from planish.sensing.sequence import Layout

Array = NDArray[np.float64]
Samples = NDArray[np.float32]

#: Full scales of sensors, also of 10, 12 and 14 bit in files of 16 bit (low or high bits used).
FULL_SCALES = (255, 1023, 4095, 16383, 65472, 65520, 65532, 65535)
#: Image rows that are looked at (in groups of three): enough for 1 % of the variance, at a tenth of the time of all.
SAMPLED_ROWS = 360
#: Bins of grey level; those with fewer samples do not count.
LEVELS, MIN_SAMPLES = 24, 400
#: Residuals beyond are not noise but motion or mixed pixels (standard deviations).
CLIP_SIGMAS = 4.0
#: Rounding to whole grey levels alone makes a variance of 1/12.
QUANTISATION = 1.0 / 12.0


def full_scale(images: Sequence[GreyImage]) -> float:
    """Return the grey level at and above which pixels of these images (H, W) count as saturated."""
    if images[0].dtype == np.uint8:
        return 255.0
    brightest = max(int(image.max()) for image in images)
    return float(next(level for level in FULL_SCALES[1:] if level >= brightest))


def estimate_noise(images: Sequence[GreyImage], layout: Layout, saturation: float) -> NoiseModel:
    """Return the variance of a grey value as a function of the grey value.

    Parameters
    ----------
    images : sequence of ndarray (H, W)
        All images of one camera, in the order of the sequence.
    layout : Layout
        What they show.
    saturation : float
        Pixels that reach this grey level in any step are left out.

    Notes
    -----
    Photon transfer: variance = offset + slope * level (Janesick, Photon Transfer, 2007), fitted to the variance in bins
    of level. With three steps only there is no residual: then the mean grey values of two periods are compared, and
    with one period of three steps the mean image with itself, which bounds the noise from above.
    """
    levels, residuals = [], []
    for contrast, weight in _contrasts(layout):
        level, residual = _sample(images, contrast, weight, saturation)
        levels.append(level)
        residuals.append(residual)
    return _fit(np.concatenate(levels), np.concatenate(residuals))


def estimate_image_noise(image: GreyImage) -> NoiseModel:
    """Return the variance of a grey value of one image (H, W) alone, from second differences along columns.

    An upper bound: the finest texture cannot be told from noise without a second image.
    """
    return _fit(*_sample([image], (0,), np.ones(1), full_scale([image])))


def _contrasts(layout: Layout) -> list[tuple[tuple[int, ...], Array]]:
    """Image indices and weights whose weighted sum holds noise only, of the variance of one image."""
    found = []
    for period in layout.periods:
        n = len(period.images)
        if n > 3:
            # The highest harmonic of N steps: orthogonal to 1, cos and sin, and the weakest in real fringes.
            weight = np.cos(2 * np.pi * (n // 2) * np.arange(n) / n)
            found.append((period.images, weight / np.linalg.norm(weight)))
    if not found and len(layout.periods) > 1:
        a, b = layout.periods[0].images, layout.periods[1].images
        weight = np.concatenate([np.full(len(a), 1 / len(a)), np.full(len(b), -1 / len(b))])
        found.append((a + b, weight / np.linalg.norm(weight)))
    if not found and layout.periods:
        n = len(layout.periods[0].images)
        found.append((layout.periods[0].images, np.full(n, n**-0.5)))
    return found or _contrasts_without_fringes(layout)


def _contrasts_without_fringes(layout: Layout) -> list[tuple[tuple[int, ...], Array]]:
    # A Gray pattern and its inverse add up to the same light, whichever bit it is.
    pairs = [
        pair
        for code in layout.codes
        if code.gray is not None
        for pair in zip(code.gray.images, code.gray.inverse, strict=True)
        if pair[1] >= 0
    ]
    if len(pairs) > 1:
        weight = np.array([0.5, 0.5, -0.5, -0.5])
        return [(a + b, weight) for a, b in itertools.pairwise(pairs)]
    # One image alone bounds the noise from above: its texture cannot be told from noise.
    shown = (*layout.white, *layout.statistical, *(code.gray.images[0] for code in layout.codes if code.gray))
    return [((shown[0],), np.ones(1))]


def _sample(
    images: Sequence[GreyImage], indices: tuple[int, ...], weight: Array, saturation: float
) -> tuple[Samples, Samples]:
    height = images[0].shape[0]
    groups = max(1, min(SAMPLED_ROWS, height) // 3)
    starts = np.unique(np.linspace(0, max(height - 3, 0), groups).astype(int))
    contrast = np.zeros((len(starts), images[0].shape[1]), np.float32)
    level = np.zeros_like(contrast)
    brightest = np.zeros_like(contrast)
    for index, w in zip(indices, weight, strict=True):
        # Second difference along the column (1, -2, 1) / sqrt(6): unit noise gain.
        for row, share in enumerate((1.0, -2.0, 1.0)):
            grey = images[index][np.minimum(starts + row, height - 1)].astype(np.float32)
            contrast += np.float32(w * share / np.sqrt(6)) * grey
            np.maximum(brightest, grey, out=brightest)
            # The grey level that the variance of the residual belongs to: each grey value by its share of it. (With an
            # odd number of steps the weights differ, and the mean of all steps is not it.)
            level += np.float32(share**2 / 6 * w**2) * grey
    if np.all(weight > 0):
        # Such a contrast is the image itself, and its own noise must not choose its bin: the pixels beside it do.
        level = 0.5 * (np.roll(level, 1, axis=1) + np.roll(level, -1, axis=1))
    usable = brightest < saturation
    return level[usable], contrast[usable]


def _fit(level: Samples, residual: Samples) -> NoiseModel:
    if len(level) < MIN_SAMPLES:
        return NoiseModel(1.0, 0.0)
    edges = np.linspace(level.min(), level.max() + 1e-6, LEVELS + 1)
    x, y, n = [], [], []
    for low, high in itertools.pairwise(edges):
        members = (level >= low) & (level < high)
        count = int(members.sum())
        if count >= MIN_SAMPLES:
            x.append(float(level[members].mean(dtype=float)))
            y.append(max(_clipped_variance(residual[members]), QUANTISATION))
            n.append(count)
    if not x:
        return NoiseModel(max(_clipped_variance(residual), QUANTISATION), 0.0)
    means, variances, counts = np.array(x), np.array(y), np.array(n, float)
    # The variance of a variance is 2 var^2 / n: weights n / var^2, square root for polyfit.
    slope = 0.0
    if len(means) >= 3:
        slope = max(float(np.polyfit(means, variances, 1, w=np.sqrt(counts) / variances)[0]), 0.0)
    weight = counts / variances**2
    offset = float((weight * (variances - slope * means)).sum() / weight.sum())
    if offset < 0:
        # A sensor without read noise: the line through the origin.
        return NoiseModel(0.0, float((weight * means * variances).sum() / (weight * means**2).sum()))
    return NoiseModel(offset, slope)


def _clipped_variance(residual: Samples) -> float:
    scale = float(np.quantile(np.abs(residual), 0.6827))
    for _ in range(3):
        kept = residual[np.abs(residual) <= CLIP_SIGMAS * max(scale, np.sqrt(QUANTISATION))]
        scale = float(np.sqrt((kept**2).mean(dtype=float)))
    return scale**2
