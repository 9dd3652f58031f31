"""By how much one image lies beside another of the same texture: gradient least squares, summed over blocks.

F(x) = T(x) and L(x) = T(x - s) give e = F - r L = s . grad t + k t with t = (F + r L) / 2 (Lucas & Kanade 1981, in its
symmetric form: the noise of e and that of grad t are uncorrelated, so noise biases the normal matrix only). r is the
smooth ratio of brightness, k what is left of it; offsets go with the local means.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map, NoiseModel

#: Side of a block [px], the unit whose scatter is looked at: larger than what blur and fringes make alike.
BLOCK_PX = 16
#: The kernel's Gaussian [px] and its reach.
BLUR_PX, REACH_PX = 1.0, 3
#: Directions in which less than this share of the gradients' power is texture are not observable: what single pixels
#: do (noise, response) is known to some per cent only.
MIN_TEXTURE_SHARE = 0.1
#: Variance that stands for "not observable" [px^2].
UNKNOWN = 1e6
#: Fewer blocks with texture say nothing about their scatter.
MIN_BLOCKS = 6
#: A movement is misjudged by this share of it (finite differences), and by this share of what is taken off the
#: gradients' power as noise: simulated shifts of 0.1 to 0.5 px.
RELATIVE_SIGMA, FLOOR_SIGMA = 0.03, 0.05

#: A difference of the images beyond this share of the noise's power is no noise; a movement has to explain half of it.
MIN_EXCESS, MIN_EXPLAINED = 0.25, 0.5

_x = np.arange(-REACH_PX, REACH_PX + 1)
_smooth = np.exp(-0.5 * (_x / BLUR_PX) ** 2)
_smooth /= _smooth.sum()
_slope = _x * _smooth / (_x**2 * _smooth).sum()
#: Power of white noise of unit variance in (gradient u, gradient v, t).
FLOOR_GAIN = np.array([1.0, 1.0, 0.0]) * (_slope @ _slope) * (_smooth @ _smooth)
FLOOR_GAIN[2] = (_smooth @ _smooth) ** 2


@dataclass(frozen=True)
class BlockSums:
    """Sums over blocks of an image, in any arrangement (...).

    Parameters
    ----------
    normal : ndarray (..., 3, 3)
        Products of (gradient u, gradient v, t).
    right : ndarray (..., 3)
        Their products with e.
    power : ndarray (...)
        e squared.
    floor : ndarray (...)
        Variance of t that belongs to single pixels: noise, response of the sensor.
    variance : ndarray (...)
        What the noise model makes of e.
    """

    normal: Array
    right: Array
    power: Array
    floor: Array
    variance: Array

    def __getitem__(self, index: tuple[slice, ...] | NDArray[np.bool_]) -> BlockSums:
        """Return the sums of some blocks."""
        return BlockSums(
            self.normal[index], self.right[index], self.power[index], self.floor[index], self.variance[index]
        )


@dataclass(frozen=True)
class Shift:
    """Movement from one image to the other.

    Parameters
    ----------
    pixels : ndarray (2,)
        (u, v) [px]; 0 along a direction that is not observable.
    covariance : ndarray (2, 2)
        [px^2]; UNKNOWN along a direction that is not observable.
    unexplained : bool
        Whether the images differ by much more than noise and this movement.
    """

    pixels: Array
    covariance: Array
    unexplained: bool = False

    @property
    def length_px(self) -> float:
        """Length of what is seen of the movement [px]."""
        return float(np.hypot(*self.pixels))

    @property
    def seen(self) -> bool:
        """Whether it is observable in every direction."""
        return bool(np.linalg.eigvalsh(self.covariance)[1] < 0.1 * UNKNOWN)

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the length [px]; of the direction seen best where some are not observable."""
        values = np.linalg.eigvalsh(self.covariance)
        if self.length_px == 0 or not self.seen:
            return float(np.sqrt(max(values[0], 0.0)))
        along = self.pixels / self.length_px
        return float(np.sqrt(along @ self.covariance @ along))

    def sigmas_beyond(self, limit_px: float) -> float:
        """Return by how many standard deviations the movement is longer than a limit [px]; 0 where it is not."""
        if self.length_px <= limit_px:
            return 0.0
        angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        # The nearest of all movements of that length, in the metric of the covariance.
        left = self.pixels - limit_px * np.stack([np.cos(angle), np.sin(angle)], -1)
        return float(np.sqrt(np.einsum("ni,ij,nj->n", left, np.linalg.inv(self.covariance), left).min()))


NOT_OBSERVABLE = Shift(np.zeros(2), UNKNOWN * np.eye(2))


def block_sums(
    first: Map, last: Map, usable: NDArray[np.uint8], noise: NoiseModel, shares: tuple[float, float], threads: int
) -> BlockSums:
    """Return the sums (H / BLOCK_PX, W / BLOCK_PX) of two images (H, W).

    `shares` is the variance of each in units of that of a single image, 1 / N for a mean of N.

    `usable` (H, W) is 1 where both images count, else 0.
    """
    sums = _core.shift_sums(first, last, usable, noise.offset, noise.slope, *shares, threads)
    order = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    return BlockSums(sums[..., order], sums[..., 6:9], sums[..., 9], sums[..., 10], sums[..., 11])


def solve_shift(sums: BlockSums, noisy: bool = True) -> Shift:
    """Return the movement that all blocks together show.

    `noisy` False: single pixels are averages without noise worth taking off, and their texture is as rough as noise.

    Notes
    -----
    Noise and response of single pixels add N to the normal matrix H: the movement is (H - N)^-1 b, its covariance the
    larger of what the noise model says, (H - N)^-1 v H (H - N)^-1, and of what the scatter of the blocks says (the
    clustered sandwich, White 1980), which holds where remains of fringes or highlights stand in e.
    """
    blocks = sums[sums.normal[..., 0, 0] > 0]
    count = len(blocks.right)
    if count < MIN_BLOCKS:
        return NOT_OBSERVABLE
    total = blocks.normal.sum(0)
    floor = blocks.floor[:, None] * FLOOR_GAIN * float(noisy)
    values, vectors = np.linalg.eigh(total)
    if values[0] <= 0:
        return NOT_OBSERVABLE
    whiten = vectors / np.sqrt(values)
    share, turn = np.linalg.eigh(whiten.T @ (total - np.diag(floor.sum(0))) @ whiten)
    basis = whiten @ turn
    seen = share > MIN_TEXTURE_SHARE
    inverse = (basis[:, seen] / share[seen]) @ basis[:, seen].T
    x = inverse @ blocks.right.sum(0)
    # Mean variance of e [grey levels squared]; every pixel's noise goes into all of the sums.
    variance = float((blocks.variance * blocks.normal[:, 0, 0]).sum() / blocks.normal[:, 0, 0].sum() / BLOCK_PX**2)
    left = blocks.right - blocks.normal @ x + floor * x
    by_noise = variance * inverse @ total @ inverse
    by_scatter = inverse @ (left.T @ left) @ inverse * count / max(count - 3, 1)
    covariance = max(by_noise[:2, :2], by_scatter[:2, :2], key=np.trace)
    parts = (basis[:, seen].T @ blocks.right.sum(0)) / share[seen]
    parts *= np.hypot(RELATIVE_SIGMA, FLOOR_SIGMA * (1 - share[seen]) / share[seen])
    systematic = basis[:2, seen] * parts
    hidden = basis[:2, ~seen]
    hidden = hidden / np.maximum(np.linalg.norm(hidden, axis=0), 1e-12)
    noise = float(blocks.variance.sum())
    excess = float(blocks.power.sum()) - noise
    unexplained = excess > MIN_EXCESS * noise and float(x @ blocks.right.sum(0)) < MIN_EXPLAINED * excess
    return Shift(x[:2], covariance + systematic @ systematic.T + UNKNOWN * hidden @ hidden.T, unexplained)
