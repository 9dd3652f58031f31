"""The texture as the refinement compares it: every frequency by what it says about a shift."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from planish.geometry import Array
from planish.measurement import Map

#: Scale over which the power spectrum is averaged (standard deviation) [cycles per pixel]: the spectrum of a grain as
#: long as 40 px is resolved.
_RESOLUTION = 0.004
#: Power counts as texture where it exceeds the noise by more than so many standard deviations of its estimate.
_SIGNIFICANT = 2.0
#: What stands at the quietest tenth of the frequencies is noise, too (pixel response, interpolation), within reason.
_QUIET, MOST_NOISE = 0.1, 2.0


@dataclass(frozen=True)
class FilteredTexture:
    """A filtered texture.

    Parameters
    ----------
    value : ndarray (H, W) float32
        0 where nothing is known.
    noise_passed : float
        Variance of what the filter leaves of white noise of unit variance.
    pixels_per_value : float
        Pixels per independent value: that of a correlation with a texture of the same spectrum, by Bartlett's formula.
    """

    value: Map
    noise_passed: float
    pixels_per_value: float


def filter_texture(value: Map, sigma: Map, shading_px: float) -> FilteredTexture:
    """Return a texture (H, W), NaN where unknown, filtered such that least squares are the most likely shift.

    Parameters
    ----------
    value, sigma : ndarray (H, W)
        Texture and standard deviation of its noise.
    shading_px : float
        Scale of the low-pass that has been taken from the texture [px]; what it left is taken out once more.

    Notes
    -----
    Of two noisy pictures of a texture of spectrum S the likelihood of a shift is the cross spectrum, weighted by
    S / (N (2 S + N)) (Knapp and Carter 1976, eq. 29 for equal noise N): the sum of squared differences of both filtered
    by its root. A strong texture is flattened, of a weak one remain the frequencies, and the directions, that it has.
    The partner's noise is taken to be as large as one's own.
    """
    known = np.isfinite(value)
    shape = value.shape[0], value.shape[1]
    size = fft.next_fast_len(shape[0], True), fft.next_fast_len(shape[1], True)
    if not known.any():
        return FilteredTexture(np.zeros(shape, np.float32), 1.0, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        power = _power(np.where(known, value / sigma, np.float32(0)), known, size)
    noise = float(np.clip(np.quantile(power, _QUIET), 1.0, MOST_NOISE))
    averaged = 4 * np.pi * (_RESOLUTION**2) * float(known.sum())
    signal = np.maximum(power / noise - 1 - _SIGNIFICANT / np.sqrt(averaged), 0)
    fy, fx = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None]
    shading = np.exp(-0.5 * (2 * np.pi * shading_px) ** 2 * (fy**2 + fx**2))
    # 2 S / (2 S + N): in units of the weight that strong textures have.
    weight = signal / (signal + 0.5) * (1 - shading) ** 2
    filtered = fft.irfft2(
        fft.rfft2(np.where(known, value, np.float32(0)), size) * np.sqrt(weight).astype(np.float32), size
    )
    # Of the real spectrum's columns all but the first stand for two.
    passed = 2 * weight.sum() - weight[:, 0].sum()
    least = 1.0 / weight.size
    return FilteredTexture(
        filtered[: shape[0], : shape[1]].astype(np.float32),
        max(float(passed) / (size[0] * size[1]), least),
        _pixels_per_value(power * weight, size),
    )


def _pixels_per_value(power: Array, size: tuple[int, int]) -> float:
    """Return sum of squares over square of the sum of a power spectrum (h, w // 2 + 1), times its frequencies.

    The variance of the correlation of two unrelated textures of this spectrum is so many times that of white ones
    (Bartlett 1935); of different spectra at most the geometric mean of both numbers (Cauchy-Schwarz), however turned.
    """
    first, second = (2 * (power**k).sum() - (power[:, 0] ** k).sum() for k in (1, 2))
    return max(float(second / first**2) * size[0] * size[1], 1.0) if first > 0 else 1.0


def _power(score: Map, known: NDArray[np.bool_], size: tuple[int, int]) -> Array:
    """Averaged power spectrum (h, w // 2 + 1) per known pixel."""
    spectrum = fft.rfft2(score, size)
    half = (spectrum.real**2 + spectrum.imag**2) / np.float32(known.sum())
    # With both halves, so that frequencies beside 0 are averaged over what lies on its other side.
    rows, columns = -np.arange(size[0]) % size[0], size[1] // 2 + 1
    whole = np.hstack([half, half[rows][:, 1 : size[1] - columns + 1][:, ::-1]])
    deviations = _RESOLUTION * size[1], _RESOLUTION * size[0]
    smooth = cv2.GaussianBlur(
        np.fft.fftshift(whole), (0, 0), deviations[0], sigmaY=deviations[1], borderType=cv2.BORDER_REFLECT_101
    )
    return np.asarray(np.fft.ifftshift(smooth)[:, :columns])
