"""The texture as the refinement compares it: every frequency by what it says about a shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from planish.measurement import Map
from planish.registration.refine.spectrum import texture_spectrum


@dataclass(frozen=True)
class FilteredTexture:
    """A filtered texture.

    Parameters
    ----------
    value : ndarray (H, W) float32
        0 where nothing is known.
    noise_passed : float
        Variance of what the filter leaves of the noise, over its stated variance.
    """

    value: Map
    noise_passed: float


def filter_texture(value: Map, sigma: Map, shading_px: float, apart: tuple[Map, Map] | None = None) -> FilteredTexture:
    """Return a texture (H, W), NaN where unknown, filtered such that least squares are the most likely shift.

    Parameters
    ----------
    value, sigma : ndarray (H, W)
        Texture and standard deviation of its noise.
    shading_px : float
        Scale of the low-pass that has been taken from the texture [px]; what it left is taken out once more.
    apart : tuple of two ndarray (H, W), optional
        What two cameras saw of it (`seen_apart`).

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
        return FilteredTexture(np.zeros(shape, np.float32), 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        score = np.where(known, value / sigma, np.float32(0))
    spectrum = texture_spectrum(score, known, size, apart)
    fy, fx = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None]
    shading = np.exp(-0.5 * (2 * np.pi * shading_px) ** 2 * (fy**2 + fx**2))
    # 2 S / (N (2 S + N)): where the noise is as stated, in units of the weight that strong textures have.
    S, N = spectrum.signal, spectrum.noise
    weight = 2 * S / (N * (2 * S + N)) * (1 - shading) ** 2
    filtered = fft.irfft2(
        fft.rfft2(np.where(known, value, np.float32(0)), size) * np.sqrt(weight).astype(np.float32), size
    )
    # Of the real spectrum's columns all but the first stand for two.
    left = weight * N
    passed = 2 * left.sum() - left[:, 0].sum()
    least = 1.0 / weight.size
    return FilteredTexture(
        filtered[: shape[0], : shape[1]].astype(np.float32), max(float(passed) / (size[0] * size[1]), least)
    )
