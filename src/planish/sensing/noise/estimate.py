"""The noise of a camera, estimated from the sequence itself.

Weighted sums of images in which light, texture and fringes cancel hold noise alone. N > 3 phase steps overdetermine
A, B and phi: their highest harmonic is such a sum. So is the difference of two periods' means, and that of a Gray
pattern and its inverse from another such pair. Where the fringes are no pure cosine, something is left; it varies
slowly along the fringes, so the second difference between three neighbouring pixels removes most of it. What is still
left can only add: the sums and directions with the least variance are the ones that count.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.measurement import NoiseModel
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import Layout
from planish.sensing.noise.grey_range import grey_range
from planish.sensing.noise.temporal import temporal_samples

Array = NDArray[np.float64]
Samples = NDArray[np.float32]

#: Image rows that are looked at (in groups of three): enough for 1 % of the variance, at a tenth of the time of all.
SAMPLED_ROWS = 360
#: Rows by which the sums are compared with each other, and by how much more variance one is left out.
COMPARED_ROWS, MAX_EXCESS = 24, 1.1
#: Bins of grey level; those with fewer samples do not count.
LEVELS, MIN_SAMPLES = 24, 400
#: Fewer statistical patterns leave too little over.
MIN_PATTERNS = 4
#: Residuals beyond are not noise but motion or mixed pixels (standard deviations).
CLIP_SIGMAS = 4.0


@dataclass(frozen=True)
class Contrast:
    """A weighted sum of images that holds noise alone, of the variance of one image.

    Parameters
    ----------
    images : tuple of int
        Indices in the sequence.
    weights : ndarray (n,)
        Sum of squares 1.
    along_rows : bool
        Second differences are taken between neighbours in a row; else in a column.
    """

    images: tuple[int, ...]
    weights: Array
    along_rows: bool = False

    def sample(
        self, images: Sequence[GreyImage], saturation: float, rows: int, first: int = 0
    ) -> tuple[Samples, Samples]:
        """Return grey levels and residuals (n,) of about so many rows, from row `first` of each interval on."""
        height = images[0].shape[0]
        groups = max(1, min(rows, height) // 3)
        starts = np.unique(np.linspace(0, max(height - 3, 0), groups).astype(int) + first)
        return _core.sample_noise(
            [np.ascontiguousarray(images[i]) for i in self.images],
            self.weights.tolist(),
            starts[starts <= max(height - 3, 0)].tolist(),
            self.along_rows,
            # Such a sum is the image itself, and its own noise must not choose its bin: the pixels beside it do.
            bool(np.all(self.weights > 0)),
            saturation,
        )


def full_scale(images: Sequence[GreyImage], layout: Layout | None = None) -> float:
    """Return the grey level at and above which pixels of these images (H, W) count as saturated.

    It is where the sine fringes of `layout` are cut off, or the full scale of the sensor.
    """
    periods = layout.periods if layout is not None else ()
    # The upper level of a square wave looks like a cut.
    fringes = [images[i] for period in periods if period.wave == "sine" for i in period.images]
    return grey_range(fringes, images).saturation


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
    of level. With one period of three steps nothing but the mean image remains, compared with itself, which bounds the
    noise from above.
    """
    quantisation = grey_range([], images).step ** 2 / 12.0
    if len(layout.statistical) > MIN_PATTERNS:
        return _fit(*temporal_samples([images[i] for i in layout.statistical], saturation), quantisation)
    contrasts = _clean(images, _contrasts(layout), saturation)
    found = [
        contrast.sample(images, saturation, SAMPLED_ROWS // len(contrasts), first)
        for first, contrast in enumerate(contrasts)
    ]
    return _fit(np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found]), quantisation)


def estimate_image_noise(image: GreyImage) -> NoiseModel:
    """Return the variance of a grey value of one image (H, W) alone, from second differences along columns.

    An upper bound: the finest texture cannot be told from noise without a second image.
    """
    sample = Contrast((0,), np.ones(1)).sample([image], full_scale([image]), SAMPLED_ROWS)
    return _fit(*sample, grey_range([], [image]).step ** 2 / 12.0)


def _contrasts(layout: Layout) -> list[Contrast]:
    found = []
    for period in layout.periods:
        n = len(period.images)
        if n > 3:
            # The highest harmonic of N steps: orthogonal to 1, cos and sin, and the weakest in real fringes.
            found.append(_contrast(period.images, np.cos(2 * np.pi * (n // 2) * np.arange(n) / n)))
    # Harmonics below the N-th cancel in the mean of N steps.
    for a, b in itertools.pairwise(layout.periods):
        weight = np.repeat([1 / len(a.images), -1 / len(b.images)], [len(a.images), len(b.images)])
        found.append(_contrast(a.images + b.images, weight))
    if not found and layout.periods:
        only = layout.periods[0].images
        found.append(_contrast(only, np.ones(len(only))))
    return found or _contrasts_without_fringes(layout)


def _contrasts_without_fringes(layout: Layout) -> list[Contrast]:
    # A Gray pattern and its inverse add up to the same light, whichever bit it is.
    pairs = [
        pair
        for code in layout.codes
        if code.gray is not None
        for pair in zip(code.gray.images, code.gray.inverse, strict=True)
        if pair[1] >= 0
    ]
    if len(pairs) > 1:
        return [_contrast(a + b, np.array([1.0, 1.0, -1.0, -1.0])) for a, b in itertools.pairwise(pairs)]
    # One image alone bounds the noise from above: its texture cannot be told from noise.
    shown = (*layout.white, *layout.statistical, *(code.gray.images[0] for code in layout.codes if code.gray))
    return [_contrast((shown[0],), np.ones(1))]


def _contrast(images: tuple[int, ...], weights: Array) -> Contrast:
    return Contrast(images, weights / np.linalg.norm(weights))


def _clean(images: Sequence[GreyImage], contrasts: Sequence[Contrast], saturation: float) -> list[Contrast]:
    """Return the contrasts, in rows or in columns, whose variance is no more than noise makes it."""
    both = [Contrast(c.images, c.weights, along) for c in contrasts for along in (False, True)]
    variances = np.full(len(both), np.inf)
    for i, contrast in enumerate(both):
        level, residual = contrast.sample(images, saturation, COMPARED_ROWS)
        if len(level):
            variances[i] = _core.bin_noise(level, residual, 1, CLIP_SIGMAS, 0.0)[1][0]
    least = variances.min()
    good = [contrast for contrast, variance in zip(both, variances, strict=True) if variance <= MAX_EXCESS * least]
    # Rows and columns of one sum hold the same noise, of which the columns are read faster.
    columns = [contrast for contrast in good if not contrast.along_rows]
    return columns or good


def _fit(level: Samples, residual: Samples, quantisation: float) -> NoiseModel:
    if len(level) < MIN_SAMPLES:
        return NoiseModel(max(1.0, quantisation), 0.0)
    floor = float(np.sqrt(quantisation))
    means, variances, counts = _core.bin_noise(level, residual, LEVELS, CLIP_SIGMAS, floor)
    enough = counts >= MIN_SAMPLES
    if not enough.any():
        variance = float(_core.bin_noise(level, residual, 1, CLIP_SIGMAS, floor)[1][0])
        return NoiseModel(max(variance, quantisation), 0.0)
    means, variances = means[enough], np.maximum(variances[enough], quantisation)
    # The variance of a variance is 2 var^2 / n: weights n / var^2, square root for polyfit.
    weight = counts[enough] / variances**2
    slope = max(float(np.polyfit(means, variances, 1, w=np.sqrt(weight))[0]), 0.0) if len(means) >= 3 else 0.0
    offset = float((weight * (variances - slope * means)).sum() / weight.sum())
    if offset < 0:
        # A sensor without read noise: the line through the origin.
        return NoiseModel(0.0, float((weight * means * variances).sum() / (weight * means**2).sum()))
    return NoiseModel(offset, slope)
