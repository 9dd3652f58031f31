"""A low-pass on blocks of pixels: what changes slowly over an image is computed on a small one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from planish import _core
from planish.measurement import Map

#: Blocks are so small that the low-pass's deviation is this many of them: it holds no finer detail.
_SIGMA_BLOCKS = 2.0
#: Share of the window that must be known.
_MIN_DENSITY = 1e-3


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

    def __call__(self, image: Map, low: float = -np.inf, high: float = np.inf) -> Map:
        """Return the mean (h, w) of the pixels with low < value < high around each block; NaN where there are none.

        Normalised convolution (Knutsson and Westin 1993).
        """
        return self.ratio(*self.sums(image, low, high))

    def sums(self, image: Map, low: float = -np.inf, high: float = np.inf) -> tuple[Map, Map]:
        """Return sum and number (h, w) of the pixels with low < value < high per block; NaN never counts."""
        return _core.block_sums(np.ascontiguousarray(image, np.float32), low, high, self.factor, self.threads)

    def ratio(self, total: Map, weight: Map) -> Map:
        """Return the low-pass of `total` over that of `weight` (h, w); NaN where there is too little weight."""
        smooth, density = self.smooth(total), self.smooth(weight)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(density > _MIN_DENSITY * self.factor**2, smooth / density, np.float32(np.nan))

    def trend(self, image: Map) -> Map:
        """Return what a plane fitted to the known pixels around each block says there (h, w); NaN where there are none.

        Inside the surface that is their mean. At its rim, where all of them lie on one side, a mean is that of another
        place, and a slope of the light would become texture (local linear regression: Fan and Gijbels 1996).
        """
        return self.trend_of(*self.sums(image))

    def trend_of(self, total: Map, weight: Map) -> Map:
        """Return the trend (h, w) of `total` over `weight`, given per block."""
        return linear_mean(total, weight, self.sigma_px / self.factor, _MIN_DENSITY * self.factor**2)

    def smooth(self, blocks: Map) -> Map:
        """Return blocks (h, w) smoothed by the Gaussian, 0 beyond the image."""
        return cv2.GaussianBlur(blocks, (0, 0), self.sigma_px / self.factor, borderType=cv2.BORDER_CONSTANT)

    def shape(self, image_shape: tuple[int, int]) -> tuple[int, int]:
        """Return (h, w) for an image of (H, W)."""
        return -(-image_shape[0] // self.factor), -(-image_shape[1] // self.factor)

    def centres(self, image: Map) -> Map:
        """Return every block's central pixel of an image (H, W) or (H, W, C)."""
        half = self.factor // 2
        h, w = self.shape((image.shape[0], image.shape[1]))
        rows, columns = (
            np.minimum(np.arange(n) * self.factor + half, size - 1)
            for n, size in ((h, image.shape[0]), (w, image.shape[1]))
        )
        return image[np.ix_(rows, columns)]

    @property
    def noise_left(self) -> float:
        """Share of a pixel's own variance that is left where the low-pass is taken from it: it holds the pixel, too."""
        # |delta - g|^2 = 1 - 2 g(0) + |g|^2 with g(0) = 1 / (2 pi s^2), |g|^2 = 1 / (4 pi s^2).
        return 1.0 - 3.0 / (4.0 * np.pi * max(self.sigma_px, 1.0) ** 2)


def linear_mean(total: Map, weight: Map, sigma: float, least: float) -> Map:
    """Return `total` over `weight` (h, w) at each place by a plane fitted around it; NaN where weight is below `least`.

    The weights of the fit are a Gaussian of deviation `sigma` times `weight` (first order of normalised convolution:
    Knutsson and Westin 1993).
    """
    reach = int(np.ceil(_REACH_SIGMAS * sigma))
    at = np.arange(-reach, reach + 1) / sigma
    bell = np.exp(-0.5 * at**2)
    kernels = [(bell * at**power / bell.sum()).astype(np.float32) for power in range(3)]

    def moment(values: Map, x: int, y: int) -> Map:
        return cv2.sepFilter2D(values, cv2.CV_32F, kernels[x], kernels[y], borderType=cv2.BORDER_CONSTANT)

    density = moment(weight, 0, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean, x, y, xx, xy, yy, slope_x, slope_y = (
            part / density
            for part in (
                moment(total, 0, 0), *(moment(weight, *k) for k in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))),
                moment(total, 1, 0), moment(total, 0, 1),
            )
        )  # fmt: skip
        # About the middle of what is known; what lies in a line says nothing about the slope across it.
        xx, xy, yy = xx - x * x + _RIDGE, xy - x * y, yy - y * y + _RIDGE
        slope_x, slope_y = slope_x - x * mean, slope_y - y * mean
        there = mean - (x * (yy * slope_x - xy * slope_y) + y * (xx * slope_y - xy * slope_x)) / (xx * yy - xy * xy)
    return np.where(density > least, there, np.float32(np.nan))


#: Reach of the Gaussian of a fit in its deviations, and what is added to the variance of the known places in its
#: variances; at a straight rim they have 0.36 across it.
_REACH_SIGMAS, _RIDGE = 3.0, np.float32(0.02)


def fill_gaps(blocks: Map, default: float) -> Map:
    """Return blocks (h, w) with NaN replaced by the mean of known neighbours, two blocks far, then by `default`."""
    filled = blocks.astype(np.float32)
    for _ in range(2):
        known = np.isfinite(filled)
        if known.all():
            return filled
        count = cv2.blur(known.astype(np.float32), (3, 3), borderType=cv2.BORDER_REPLICATE)
        total = cv2.blur(np.where(known, filled, np.float32(0)), (3, 3), borderType=cv2.BORDER_REPLICATE)
        with np.errstate(divide="ignore", invalid="ignore"):
            filled = np.where(known, filled, np.where(count > 0, total / count, np.float32(np.nan)))
    return np.nan_to_num(filled, nan=default)
