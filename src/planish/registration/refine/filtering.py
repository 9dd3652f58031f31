"""The texture as the refinement compares it: every frequency by what it says about a shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish import _core
from planish.geometry import Array
from planish.measurement import Map
from planish.registration.refine.bending import filter_reach
from planish.registration.refine.spectrum import Grid, texture_spectrum


@dataclass(frozen=True)
class FilteredTexture:
    """A filtered texture.

    Parameters
    ----------
    value : ndarray (H, W) float32
        0 where nothing is known.
    noise_passed : float
        Variance of what the filter leaves of the noise, over its stated variance.
    pixels_per_value : float
        Pixels per independent value: that of a correlation with a texture of the same spectrum, by Bartlett's formula.
    reach : ndarray (2, 2, 2, 2)
        How far the filter and the low-pass before it reach (`filter_reach`) [px^2].
    """

    value: Map
    noise_passed: float
    pixels_per_value: float
    reach: Array


def filter_texture(
    value: Map, sigma: Map, shading_px: float, apart: tuple[Map, Map] | None = None, threads: int = 1
) -> FilteredTexture:
    """Return a texture (H, W), NaN where unknown, filtered such that least squares are the most likely shift.

    Parameters
    ----------
    value, sigma : ndarray (H, W)
        Texture and standard deviation of its noise.
    shading_px : float
        Scale of the low-pass that has been taken from the texture [px]; what it left is taken out once more.
    apart : tuple of two ndarray (H, W), optional
        What two cameras saw of it (`seen_apart`).
    threads : int

    Notes
    -----
    Of two noisy pictures of a texture of spectrum S the likelihood of a shift is the cross spectrum, weighted by
    S / (N (2 S + N)) (Knapp and Carter 1976, eq. 29 for equal noise N): the sum of squared differences of both filtered
    by its root. A strong texture is flattened, of a weak one remain the frequencies, and the directions, that it has.
    The partner's noise is taken to be as large as one's own.
    """
    known = np.isfinite(value)
    shape = value.shape[0], value.shape[1]
    if not known.any():
        return FilteredTexture(np.zeros(shape, np.float32), 1.0, 1.0, np.zeros((2, 2, 2, 2)))
    grid = Grid.of(shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        score = np.where(known, value / sigma, np.float32(0))
    found = texture_spectrum(score, known, grid, apart, threads)
    S, N = found.signal, found.noise
    # 2 S / (N (2 S + N)): where the noise is as stated, in units of the weight that strong textures have.
    weight = 2 * S / (N * (2 * S + N))
    spectrum = grid.transform(np.where(known, value, np.float32(0)))
    _core.weigh_spectrum(spectrum, np.sqrt(weight), grid.step, shading_px, threads)
    fy, fx = np.fft.fftfreq(grid.cells[0])[:, None], np.fft.rfftfreq(grid.cells[1])[None]
    shading = np.exp(-0.5 * (2 * np.pi * shading_px) ** 2 * (fy**2 + fx**2))
    weight = weight * (1 - shading) ** 2
    passed, least = _sum(weight * N) / (grid.cells[0] * grid.cells[1]), 1.0 / weight.size
    return FilteredTexture(
        grid.inverse(spectrum)[: shape[0], : shape[1]],
        max(passed, least),
        _pixels_per_value((S + N) * weight, grid),
        # The contrast is what the low-pass of the shading left, taken twice.
        filter_reach(np.sqrt(weight) * (1 - shading) ** 2, S * weight, grid.cells, shading_px),
    )


def _sum(half: Array) -> float:
    """Sum over the whole spectrum of what stands at half of it: all columns but the first and last stand for two."""
    return float(2 * half.sum() - half[:, 0].sum() - half[:, -1].sum())


def _pixels_per_value(power: Array, grid: Grid) -> float:
    """Return sum of squares over square of the sum of a power spectrum at cells, times its frequencies.

    The variance of the correlation of two unrelated textures of this spectrum is so many times that of white ones
    (Bartlett 1935); of different spectra at most the geometric mean of both numbers (Cauchy-Schwarz), however turned.
    """
    first, second = _sum(power), _sum(power**2)
    return max(second / first**2 * grid.cells[0] * grid.cells[1], 1.0) if first > 0 else 1.0
