"""Spectra of a texture and of its noise, from what two cameras see alike.

The noise of a texture is not quite white: half of it was read between another camera's pixels. Weak texture cannot be
told from that by its own spectrum. Two cameras see one texture with noise of their own, so that the cross
spectrum of what they see has that of the texture as its mean (Bendat and Piersol, Random Data, 4th ed. 2010, sec. 5.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.registration.refine.smoothing import smooth_map

#: Scales over which spectra are averaged (standard deviation) [cycles per pixel]: by the first the spectrum of a grain
#: as long as 40 px is resolved; the second finds what is too weak for that.
_RESOLUTIONS = 0.004, 0.016
#: Power counts as texture where it exceeds what noise makes of it by more than so many of its standard deviations.
_SIGNIFICANT = 2.0
#: Where one camera alone saw the texture, what stands at the quietest tenth of the frequencies is noise.
_QUIET = 0.1
#: Noise exceeds what is stated (pixel response, interpolation, dust, shading by noisy normals) by this factor at most.
MOST_NOISE = 2.0
#: What two cameras have in common is known to this share: one of them is read between its pixels.
_UNCERTAIN = 0.5
#: Contrasts beyond this are highlights and holes.
_MAX_CONTRAST = 0.5


@dataclass(frozen=True)
class Spectrum:
    """Power per pixel of texture and of its noise (h, w // 2 + 1), in units of the stated variance of the noise."""

    signal: Array
    noise: Array


def texture_spectrum(
    score: Map, known: NDArray[np.bool_], size: tuple[int, int], apart: tuple[Map, Map] | None = None
) -> Spectrum:
    """Return the spectra of a texture.

    Parameters
    ----------
    score : ndarray (H, W)
        Texture over the standard deviation of its noise, 0 where unknown.
    known : ndarray (H, W) bool
    size : tuple of two int
        Rows and columns (h, w) of the transform.
    apart : tuple of two ndarray (H, W), optional
        The same texture as two cameras saw it, each with noise of its own, over that standard deviation; 0 where
        unknown.
    """
    number = float(known.sum())
    power = _averaged(_power(fft.rfft2(score, size)), size, _RESOLUTIONS[0]) / number
    if apart is None:
        noise = np.clip(np.quantile(power, _QUIET), 1.0, MOST_NOISE)
        chance = noise / _root_of_averaged(number, _RESOLUTIONS[0])
        return Spectrum(np.maximum(power - noise - _SIGNIFICANT * chance, 0), np.full_like(power, noise))
    signal = np.maximum(_common(apart, size, number), power - MOST_NOISE)
    return Spectrum(signal, np.clip(power - (1 + _UNCERTAIN) * signal, 1.0, MOST_NOISE))


def _common(apart: tuple[Map, Map], size: tuple[int, int], number: float) -> Array:
    """Return the power (h, w // 2 + 1) of what two images have in common, 0 where it is not significant."""
    first, second = (fft.rfft2(image, size) for image in apart)
    cross = first.real * second.real + first.imag * second.imag
    out, rest = np.zeros_like(cross), np.ones_like(cross)
    for scale in _RESOLUTIONS:
        left = _averaged(rest, size, scale)
        mean, *powers = (_averaged(p * rest, size, scale) for p in (cross, _power(first), _power(second)))
        # Variance of the real part of a cross spectrum without coherence: half the product of the powers (ibid., 9.1).
        chance = np.sqrt(np.maximum(powers[0] * powers[1], 0) / 2) / _root_of_averaged(number, scale)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.nan_to_num((mean - _SIGNIFICANT * chance) / (left * number))
        out = np.where((rest > 0) & (found > 0), found, out)
        rest = np.where(out > 0, np.float32(0), rest)
    return out


def _root_of_averaged(number: float, scale: float) -> float:
    """Root of the number of independent frequencies that are averaged, of as many as known pixels."""
    return float(np.sqrt(4 * np.pi * scale**2 * number))


def seen_apart(
    measurement: Measurement, inside: NDArray[np.bool_], sigma: Map, shading_px: float
) -> tuple[Map, Map] | None:
    """Return what each of two cameras saw of the texture, over `sigma` (H, W); None where one camera alone saw it.

    The mean of the fringe images, or white, without its slow changes (`shading_px`), on the organising camera's grid; 0
    beside `inside` (H, W), the pixels around which the surface is seen.
    """
    names = measurement.texture_views
    if len(names) != 2 or measurement.correspondence_px is None:
        return None
    where = np.ascontiguousarray(np.nan_to_num(measurement.correspondence_px, nan=-1e4))
    own, known = [], measurement.valid & np.isfinite(sigma)
    for name in names:
        view = measurement.views[name]
        image = view.mean if view.mean is not None else view.white
        if image is None:
            return None
        if name != measurement.organised_on:
            image = cv2.remap(image, where, None, cv2.INTER_LINEAR, borderValue=(np.nan,))
        own.append(image)
        known &= np.isfinite(image)
    density = smooth_map(known.astype(np.float32), shading_px, shading_px)
    out = []
    for image in own:
        with np.errstate(divide="ignore", invalid="ignore"):
            light = smooth_map(np.where(known, image, np.float32(0)), shading_px, shading_px)
            contrast = image * density / light - 1
            contrast = np.clip(contrast, -_MAX_CONTRAST, _MAX_CONTRAST) / sigma
        out.append(np.where(known & inside & np.isfinite(contrast), contrast, np.float32(0)))
    return out[0], out[1]


def _power(spectrum: NDArray[np.complexfloating]) -> Array:
    return np.asarray(spectrum.real**2 + spectrum.imag**2)


def _averaged(half: Array, size: tuple[int, int], scale: float) -> Map:
    """Average of a half spectrum (h, w // 2 + 1) over frequencies around [standard deviation, cycles per pixel]."""
    rows, columns = (scale * n for n in size)
    around = int(np.ceil(_REACH * rows)), int(np.ceil(_REACH * columns))
    smooth = smooth_map(_continued(half.astype(np.float32, copy=False), size, around), rows, columns)
    return smooth[around[0] : around[0] + half.shape[0], around[1] : around[1] + half.shape[1]]


#: How far averages over frequencies reach, in standard deviations.
_REACH = 5.0


def _continued(half: Map, size: tuple[int, int], around: tuple[int, int]) -> Map:
    """Return a half spectrum (h, w // 2 + 1) of a real image, continued by so many rows and columns on all sides.

    Spectra are periodic; those of opposite frequencies are alike.
    """
    (rows, columns), width = around, half.shape[1]
    opposite = np.roll(half[::-1], 1, axis=0)
    # Behind the highest frequency w // 2 follows that opposite to w - w // 2 - 1.
    last = size[1] - width
    left, right = opposite[:, columns:0:-1], opposite[:, last : last - columns : -1]
    return cv2.copyMakeBorder(np.hstack([left, half, right]), rows, rows, 0, 0, cv2.BORDER_WRAP)
