"""The texture of an unrolled piece of surface, coarser and in units of its noise, ready for correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.texture.resample import TextureImage

#: A chart smaller than this share of the largest holds too little for correlation.
_LEAST_CHART = 0.2
#: Pixels that are averaged must be known to this share.
_KNOWN = 0.99
#: Contrast beyond this many robust deviations is left out with its neighbours, and beyond the other it is clipped.
_WILD, _CLIP = 8.0, 4.0
#: The noise is always the same.
_NOISE_KEY = 5


@dataclass(frozen=True)
class Development:
    """One texture image reduced by a whole factor.

    Parameters
    ----------
    image : TextureImage
        What is reduced.
    factor : int
        Pixels of the image along each axis that make one of the development.
    value : ndarray (h, w) float32
        Local contrast over its standard deviation (white noise has variance 1 before averaging), 0 outside `mask`.
    noise : ndarray (h, w) float32
        White noise that went the same way as `value`: what the texture has to rise above.
    mask : ndarray (h, w) bool
        Where there is texture to be trusted.
    source_px : ndarray (h, w, 2) float32
        Pixel (u, v) of the organising camera; NaN outside the surface.
    """

    image: TextureImage
    factor: int
    value: Map
    noise: Map
    mask: NDArray[np.bool_]
    source_px: Map = field(metadata={"unit": "px"})

    @property
    def pitch_mm(self) -> float:
        """Size of a pixel [mm]."""
        return self.image.pitch_mm * self.factor

    def locate(self, xy: Array, angle_rad: Array) -> tuple[Array, Array, Array]:
        """Return points, frames and camera pixels of places (N, 2) as `TextureImage.locate` does."""
        # The centre of a pixel is that of the block of pixels it stands for.
        return self.image.locate((xy + 0.5) * self.factor - 0.5, angle_rad)


def develop(images: Sequence[TextureImage], factor: int) -> tuple[Development, ...]:
    """Return the large texture images, reduced by a whole factor."""
    sizes = [int(image.mask.sum()) for image in images]
    least = _LEAST_CHART * max(sizes, default=0)
    return tuple(
        _reduced(image, factor) for image, size in zip(images, sizes, strict=True) if size > 0 and size >= least
    )


def _reduced(image: TextureImage, factor: int) -> Development:
    score, noise, known = _scores(image)
    height, width = (n // factor for n in image.mask.shape)
    whole = np.s_[: height * factor, : width * factor]

    def mean(values: Map) -> Map:
        return cv2.resize(np.ascontiguousarray(values[whole]), (width, height), interpolation=cv2.INTER_AREA)

    mask = mean(known.astype(np.float32)) > _KNOWN
    value, noise = (np.where(mask, mean(values), np.float32(0)) for values in (score, noise))
    # The mean of a block's pixels stands at its centre; NaN in a sum is NaN in one of its terms.
    return Development(image, factor, value, noise, mask, mean(image.source_px))


def _scores(image: TextureImage) -> tuple[Map, Map, NDArray[np.bool_]]:
    """Contrast over noise, a white noise like it, and where both are to be trusted."""
    known = image.mask & (image.sigma > 0)
    score = np.where(known, image.value / np.where(known, image.sigma, np.float32(1)), np.float32(0))
    # Rims, highlights and dust are no Gaussian texture: a few of their values would outweigh the rest.
    spread = 1.4826 * np.median(np.abs(score[known])) if known.any() else 1.0
    wild = cv2.dilate((np.abs(score) > _WILD * spread).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    known &= ~wild & (cv2.erode(image.mask.astype(np.uint8), np.ones((7, 7), np.uint8), borderValue=0) > 0)
    score = np.where(known, np.clip(score, -_CLIP * spread, _CLIP * spread), np.float32(0))
    noise = np.random.Generator(np.random.Philox(key=_NOISE_KEY)).standard_normal(score.shape, np.float32)
    return score.astype(np.float32), np.where(known, noise, np.float32(0)), known
