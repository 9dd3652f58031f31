"""Texture images made ready for correlation: every frequency and every pixel weighted by what it says about the place.

Two noisy pictures of one texture are told from two of different ones best by their product weighted with S / (S + N)^2
in the frequency domain, S the spectrum of the texture and N that of the noise (Eckart filter; Knapp and Carter, The
generalized correlation method for estimation of time delay, 1976). Each picture takes the root of it. Where the texture
is far above the noise this makes the spectrum flat, so that a coarse mottle does not hide the fine detail that fixes
the place; where it drowns in noise, only the frequencies that hold texture remain. The spectrum is measured: nothing is
assumed about the texture's direction or scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.fft

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.texture.resample import TextureImage

#: Edge of the tiles that the spectrum is measured on [px].
_TILE_PX = 64
#: Tiles that know the spectrum well enough, spread over the picture.
_ENOUGH_TILES = 80
#: Half the edge of the filter's kernel [px].
_KERNEL_HALF_PX = 16
#: Values beyond so many robust deviations grow only with their logarithm: specks count, but do not rule.
_COMPRESSED_BEYOND = 2.0
#: Low-pass that keeps the peak of the correlation wide enough for a search in whole pixels [px].
_LOWPASS_PX = 0.5
#: Least signal assumed, in parts of the noise: without it a spectrum below the stated noise would give no filter.
_LEAST_SIGNAL = 0.02


@dataclass(frozen=True)
class PatchImage:
    """A texture image weighted for correlation.

    Parameters
    ----------
    value : ndarray (h, w) float32
        Mean 0 and deviation 1; exactly 0 where there is no texture.
    cells_per_px : float
        Independent values per pixel: the correlation of n pixels of two unrelated pictures has the variance
        1 / (n cells_per_px).
    """

    value: Map
    cells_per_px: float


def patch_images(images: tuple[TextureImage, ...]) -> tuple[PatchImage, ...]:
    """Return the pictures that patches of the texture images are compared on."""
    return tuple(_patch_image(image) for image in images)


def _patch_image(image: TextureImage) -> PatchImage:
    if not image.mask.any():
        return PatchImage(np.zeros(image.mask.shape, np.float32), 1.0)
    compressed = _compressed(image)
    power, noise = _spectra(compressed, image)
    signal = np.maximum(power - noise, _LEAST_SIGNAL * noise)
    frequency = np.fft.fftfreq(_TILE_PX)
    radius = np.hypot(frequency[:, None], frequency[None])
    response = np.sqrt(signal) / (signal + noise) * np.exp(-0.5 * (2 * np.pi * _LOWPASS_PX * radius) ** 2)
    # The mean belongs to the shading.
    response[0, 0] = 0.0
    filtered = cv2.filter2D(compressed, cv2.CV_32F, _kernel(response), borderType=cv2.BORDER_CONSTANT)
    # A pixel counts by how much of its variance is texture.
    texture = float(signal.mean())
    value = np.where(image.mask, filtered * (texture + noise) / (texture + image.sigma**2), 0).astype(np.float32)
    value /= max(float(np.sqrt((value[image.mask].astype(float) ** 2).mean())), 1e-30)
    passed = response**2 * power
    # Sum over all shifts of the squared autocorrelation, by Parseval's theorem.
    return PatchImage(value, float(passed.mean() ** 2 / (passed**2).mean()))


def _compressed(image: TextureImage) -> Map:
    inside = image.value[image.mask][::_SAMPLE_STRIDE]
    deviation = max(1.4826 * float(np.median(np.abs(inside - np.median(inside)))), 1e-9)
    scale = np.float32(_COMPRESSED_BEYOND * deviation)
    # Values are 0 outside the mask.
    return scale * np.arcsinh(image.value / scale)


#: Every n-th pixel decides about the deviation.
_SAMPLE_STRIDE = 7


def _spectra(value: Map, image: TextureImage) -> tuple[Array, float]:
    """Power spectrum (tile, tile) of the texture with its noise, and that of the noise, which is white; per pixel."""
    window = np.outer(*2 * [np.hanning(_TILE_PX + 2)[1:-1]]).astype(np.float32)
    tapered = window * _tiles(image.mask.astype(np.float32))
    weight = tapered**2
    energy = max(float(weight.sum(dtype=float)), 1e-30)
    half = scipy.fft.rfft2(_tiles(value) * tapered)
    half_power = (half.real**2 + half.imag**2).sum(0, dtype=float) / energy
    # The other half of the spectrum of real values is its mirror image.
    rows = -np.arange(_TILE_PX) % _TILE_PX
    power = np.hstack([half_power, half_power[rows, 1:-1][:, ::-1]])
    power = np.fft.ifftshift(cv2.GaussianBlur(np.fft.fftshift(power), (0, 0), 1.0, borderType=cv2.BORDER_REFLECT_101))
    noise = float((weight * _tiles(image.sigma) ** 2).sum(dtype=float) / energy)
    # What stands at the quietest frequencies is noise, too (pixel response, interpolation), within reason.
    return power, float(np.clip(np.quantile(power, 0.1), noise, 2 * noise))


def _tiles(image: Map) -> Map:
    """Cut an image into tiles (n, tile, tile), the last ones filled up with zeros; of many only every k-th."""
    height, width = image.shape
    rows, columns = -(-height // _TILE_PX), -(-width // _TILE_PX)
    filled = np.pad(image, ((0, rows * _TILE_PX - height), (0, columns * _TILE_PX - width)))
    tiles = filled.reshape(rows, _TILE_PX, columns, _TILE_PX).swapaxes(1, 2)
    which = np.arange(0, rows * columns, -(-rows * columns // _ENOUGH_TILES))
    return np.asarray(tiles[which // columns, which % columns])


def _kernel(response: Array) -> Map:
    """Impulse response of a real and even frequency response, cut smoothly."""
    middle, half = _TILE_PX // 2, _KERNEL_HALF_PX
    impulse = np.fft.fftshift(np.fft.ifft2(response).real)[
        middle - half : middle + half + 1, middle - half : middle + half + 1
    ]
    return (impulse * np.outer(*2 * [np.hanning(2 * half + 3)[1:-1]])).astype(np.float32)
