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

from planish import _core
from planish.measurement import Map, Measurement
from planish.registration.refine.smoothing import smooth_map

#: Scales over which spectra are averaged (standard deviation) [cycles per pixel]: by the first the spectrum of a grain
#: as long as 40 px is resolved; the second finds what is too weak for that.
_RESOLUTIONS = 0.004, 0.016
#: Cells per standard deviation of the finest average.
_CELLS = 2.0
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
    """Power per pixel of texture and of its noise at cells (h, w), in units of the stated variance of the noise."""

    signal: Map
    noise: Map


@dataclass(frozen=True)
class Grid:
    """Frequencies of an image's transform, and cells of them: no finer than what spectra are averaged over.

    Parameters
    ----------
    size : tuple of two int
        Rows and columns of the transform.
    step : int
        Cells are every n-th frequency along rows and columns of the half spectrum.
    """

    size: tuple[int, int]
    step: int = 1

    @classmethod
    def of(cls, shape: tuple[int, int]) -> Grid:
        """Return a grid for images (H, W) whose transform is fast."""
        step = max(1, int(_RESOLUTIONS[0] * min(shape) / _CELLS))
        # As many columns that the highest frequency is a cell, too.
        rows, columns = (
            n * fft.next_fast_len(-(-size // n), True) for size, n in zip(shape, (step, 2 * step), strict=True)
        )
        return cls((rows, columns), step)

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of the cells of a whole spectrum."""
        return self.size[0] // self.step, self.size[1] // self.step

    def transform(self, image: Map) -> Map:
        """Return the half spectrum (h, w // 2 + 1, 2) of an image: real and imaginary parts."""
        found = fft.rfft2(np.asarray(image, np.float32), self.size)
        return found.view(np.float32).reshape(*found.shape, 2)

    def inverse(self, spectrum: Map) -> Map:
        """Return the image (h, w) of a half spectrum."""
        return np.asarray(fft.irfft2(spectrum.view(np.complex64)[..., 0], self.size))

    def average(self, cells: Map, scale: float) -> Map:
        """Average of a map at cells over frequencies around [standard deviation, cycles per pixel]."""
        # What the cells and the interpolation between them add to the variance is taken from the Gaussian's.
        added = (1 - 1 / self.step**2) / 3
        rows, columns = (float(np.sqrt((scale * n / self.step) ** 2 - added)) for n in self.size)
        around = int(np.ceil(_REACH * rows)), int(np.ceil(_REACH * columns))
        smooth = smooth_map(_continued(cells, self.cells, around), rows, columns)
        return smooth[around[0] : around[0] + cells.shape[0], around[1] : around[1] + cells.shape[1]]


def texture_spectrum(
    score: Map, known: NDArray[np.bool_], grid: Grid, apart: tuple[Map, Map] | None = None, threads: int = 1
) -> Spectrum:
    """Return the spectra of a texture.

    Parameters
    ----------
    score : ndarray (H, W)
        Texture over the standard deviation of its noise, 0 where unknown.
    known : ndarray (H, W) bool
    grid : Grid
    apart : tuple of two ndarray (H, W), optional
        The same texture as two cameras saw it, each with noise of its own, over that standard deviation; 0 where
        unknown.
    threads : int
    """
    number = float(np.count_nonzero(known))
    spectrum = grid.transform(score)
    power = grid.average(_core.spectrum_products(spectrum, spectrum, grid.step, threads), _RESOLUTIONS[0])
    power = power / np.float32(number)
    if apart is None:
        noise = np.clip(np.quantile(power, _QUIET), 1.0, MOST_NOISE)
        chance = noise / _root_of_averaged(number, _RESOLUTIONS[0])
        return Spectrum(np.maximum(power - noise - _SIGNIFICANT * chance, 0), np.full_like(power, noise))
    signal = np.maximum(_common(apart, grid, number, threads), power - MOST_NOISE)
    return Spectrum(signal, np.clip(power - (1 + _UNCERTAIN) * signal, 1.0, MOST_NOISE))


def _common(apart: tuple[Map, Map], grid: Grid, number: float, threads: int) -> Map:
    """Return the power at cells (h, w) of what two images have in common, 0 where it is not significant."""
    first, second = (grid.transform(image) for image in apart)
    products = [
        _core.spectrum_products(*two, grid.step, threads) for two in ((first, second), (first, first), (second, second))
    ]
    out, rest = np.zeros_like(products[0]), np.ones_like(products[0])
    for scale in _RESOLUTIONS:
        left = grid.average(rest, scale)
        mean, *powers = (grid.average(p * rest, scale) for p in products)
        # Variance of the real part of a cross spectrum without coherence: half the product of the powers (ibid., 9.1).
        chance = np.sqrt(np.maximum(powers[0] * powers[1], 0) / 2) / _root_of_averaged(number, scale)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.nan_to_num((mean - _SIGNIFICANT * chance) / (left * number))
        out = np.where((rest > 0) & (found > 0), found, out)
        rest = np.where(out > 0, np.float32(0), rest)
    return np.asarray(out, np.float32)


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
    where = np.array(measurement.correspondence_px, np.float32, order="C")
    cv2.patchNaNs(where.reshape(len(where), -1), -1e4)
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
    out, shown = [], known & inside
    for image in own:
        with np.errstate(divide="ignore", invalid="ignore"):
            # In place: whole frames of temporaries take longer than the arithmetic.
            contrast = image * density
            contrast /= smooth_map(np.where(known, image, np.float32(0)), shading_px, shading_px)
            contrast -= 1
            np.clip(contrast, -_MAX_CONTRAST, _MAX_CONTRAST, out=contrast)
            contrast /= sigma
        contrast[~(shown & np.isfinite(contrast))] = 0
        out.append(contrast)
    return out[0], out[1]


#: How far averages over frequencies reach, in standard deviations.
_REACH = 5.0


def _continued(half: Map, size: tuple[int, int], around: tuple[int, int]) -> Map:
    """Return a map (h, w // 2 + 1) over half a spectrum, continued by so many rows and columns on all sides.

    Spectra of real images are periodic; those of opposite frequencies are alike.
    """
    (rows, columns), width = around, half.shape[1]
    opposite = np.roll(half[::-1], 1, axis=0)
    # Behind the highest frequency w // 2 follows that opposite to w - w // 2 - 1.
    last = size[1] - width
    left, right = opposite[:, columns:0:-1], opposite[:, last : last - columns : -1]
    return cv2.copyMakeBorder(np.hstack([left, half, right]), rows, rows, 0, 0, cv2.BORDER_WRAP)
