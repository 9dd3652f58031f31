"""Orientation of keypoints: the prevailing directions of the gradient around them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.keypoints.blobs import SmoothTexture
from planish.registration.texture.sampling import parabola_vertex, sample

#: Bins of a histogram of directions, and the smoothing over it [bins]: so wide that it is a mean direction. A narrower
#: one follows the noise of single gradients.
_BINS, _BIN_SIGMA = 36, 3.0
#: Gradients are sampled one scale apart, within twice the standard deviation of their weights.
_REACH = 2.0


def orient(
    texture: SmoothTexture, xy: Array, orientation_scales: float, second: float
) -> tuple[Array, NDArray[np.intp], Array]:
    """Return the orientations of places (N, 2), from histograms of gradients (Lowe 2004, section 5).

    Returns
    -------
    angle : ndarray (N,)
        The prevailing direction, from the chart's x axis towards y [rad].
    which : ndarray (M,) intp
        The places that have a second direction of at least `second` of the first one's strength.
    second_angle : ndarray (M,)
        That direction [rad].
    """
    histogram = _histogram(texture, xy, orientation_scales)
    before, after = np.roll(histogram, 1, 1), np.roll(histogram, -1, 1)
    peak = np.where((histogram > before) & (histogram >= after), histogram, 0.0)
    rows = np.arange(len(xy))

    def highest() -> tuple[Array, Array]:
        at = peak.argmax(1)
        left, right, height = before[rows, at], after[rows, at], peak[rows, at]
        peak[rows, at] = 0.0
        return (at + parabola_vertex(left, height, right)) * (2 * np.pi / _BINS), height

    angle, strongest = highest()
    second_angle, height = highest()
    which = np.flatnonzero((height > 0) & (height >= second * strongest))
    return angle, which, second_angle[which]


def _histogram(texture: SmoothTexture, xy: Array, orientation_scales: float) -> Array:
    """Smoothed histograms (N, bins) of the gradient's direction around each place, weighted by its length."""
    x, y, weight = _samples(orientation_scales)
    places = xy[:, None] + texture.scale_px * np.column_stack([x, y])
    gx, gy = (sample(np.asarray(cv2.Scharr(texture.value, cv2.CV_32F, *axis)), places) for axis in ((1, 0), (0, 1)))
    length = np.hypot(gx, gy) * weight
    at = np.arctan2(gy, gx) * np.float32(_BINS / (2 * np.pi))
    low = np.floor(at)
    share = at - low
    first = np.arange(len(xy))[:, None] * _BINS
    size = len(xy) * _BINS
    bins = low.astype(np.intp) % _BINS
    total = np.bincount((first + bins).ravel(), (length * (1 - share)).ravel(), size)
    total += np.bincount((first + (bins + 1) % _BINS).ravel(), (length * share).ravel(), size)
    spectrum = np.fft.rfft(total.reshape(-1, _BINS), axis=1)
    # A Gaussian over the bins multiplies their Fourier series.
    spectrum *= np.exp(-0.5 * (np.arange(spectrum.shape[1]) * (2 * np.pi / _BINS * _BIN_SIGMA)) ** 2)
    return np.fft.irfft(spectrum, _BINS, axis=1)


def _samples(orientation_scales: float) -> tuple[Map, Map, Map]:
    """Offsets (S,) of the gradients in multiples of the scale, and their weights."""
    reach = int(np.ceil(_REACH * orientation_scales))
    x, y = (m.ravel() for m in np.meshgrid(*2 * (np.arange(-reach, reach + 1, dtype=np.float32),)))
    inside = np.hypot(x, y) <= _REACH * orientation_scales
    x, y = x[inside], y[inside]
    return x, y, np.exp(-(x**2 + y**2) / np.float32(2 * orientation_scales**2))
