"""A low-pass on blocks of pixels: what changes slowly over an image is computed on a small one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map

#: Blocks are so small that the low-pass's deviation is this many of them: it holds no finer detail.
_SIGMA_BLOCKS = 2.0
#: Share of the window that must be known.
_MIN_DENSITY = 1e-3
#: The window reaches so many standard deviations far.
_REACH_SIGMAS = 4.0
#: Across what is thinner than this share of the window's variance there is no slope; a half window has a third.
_THIN = 0.01
#: What lies to one side of a block never changes its level by more than this share.
_STEEPEST = 0.5
#: What the kernels take for a mask that leaves nothing out.
EVERYWHERE = np.empty((0, 0), np.uint8)


def bell(sigma: float, reach: int) -> Array:
    """Return a Gaussian of sum 1 at -reach to reach."""
    values = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(values / values.sum())


@dataclass(frozen=True)
class Lowpass:
    """Gaussian low-pass of deviation `sigma_px` of images (H, W), given at blocks (h, w) of `factor` pixels."""

    sigma_px: float
    factor: int
    threads: int

    @classmethod
    def of(cls, sigma_px: float, threads: int) -> Lowpass:
        """Return the low-pass with the largest blocks that it allows."""
        return cls(sigma_px, max(1, round(sigma_px / _SIGMA_BLOCKS)), threads)

    def __call__(
        self, image: Map, low: float = -np.inf, high: float = np.inf, seen: NDArray[np.bool_] | None = None
    ) -> Map:
        """Return the mean (h, w) of the pixels with low < value < high around each block; NaN where there are none.

        Where `seen` (H, W) is given, pixels count only there. Normalised convolution (Knutsson and Westin 1993).
        """
        return self.ratio(*self.sums(image, low, high, seen))

    def sums(
        self, image: Map, low: float = -np.inf, high: float = np.inf, seen: NDArray[np.bool_] | None = None
    ) -> tuple[Map, Map]:
        """Return sum and number (h, w) of the pixels with low < value < high per block; NaN never counts."""
        where = EVERYWHERE if seen is None else np.ascontiguousarray(seen).view(np.uint8)
        return _core.block_sums(np.ascontiguousarray(image, np.float32), low, high, where, self.factor, self.threads)

    def ratio(self, total: Map, weight: Map) -> Map:
        """Return the low-pass of `total` over that of `weight` (h, w); NaN where there is too little weight.

        A plane is fitted around each block (local linear regression: Fan and Gijbels 1996, section 3.2). At a rim, all
        that is known lies to one side: a mean would miss the slope of the light, and show the rim as a line.
        """
        reach = round(_REACH_SIGMAS * self._sigma_blocks)
        least, thin = _MIN_DENSITY * self.factor**2, _THIN * self._sigma_blocks**2
        total, weight = np.ascontiguousarray(total, np.float32), np.ascontiguousarray(weight, np.float32)
        return _core.local_planes(
            total, weight, bell(self._sigma_blocks, reach).tolist(), least, thin, _STEEPEST, self.threads
        )

    @property
    def _sigma_blocks(self) -> float:
        return self.sigma_px / self.factor

    def shape(self, image_shape: tuple[int, int]) -> tuple[int, int]:
        """Return (h, w) for an image of (H, W)."""
        return -(-image_shape[0] // self.factor), -(-image_shape[1] // self.factor)

    def centres(self, image: Map) -> Map:
        """Return every block's central pixel (h, w, C) of an image (H, W, C)."""
        return _core.block_centres(np.ascontiguousarray(image, np.float32), self.factor)

    def noise_left(self, passes: int = 1) -> float:
        """Share of a pixel's own variance that is left where one or two passes of the low-pass are taken from it.

        The low-pass holds the pixel, too: |delta - k|^2 = 1 - 2 k(0) + |k|^2 for the kernel k, the Gaussian g itself or
        2 g - g * g for two passes; n-fold convolutions of g have the value 1 / (2 pi n s^2) in their middle.
        """
        share = 3 / 4 if passes == 1 else 25 / 24
        return 1.0 - share / (np.pi * max(self.sigma_px, 1.0) ** 2)


def fill_gaps(blocks: Map, default: float) -> Map:
    """Return blocks (h, w) with NaN replaced by the mean of known neighbours, two blocks far, then by `default`."""
    return _core.fill_gaps(np.ascontiguousarray(blocks, np.float32), default)
