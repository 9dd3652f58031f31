"""What is fixed to a camera's pixels, as far as the captures of a run tell, and its removal from a contrast."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from planish import _core
from planish.measurement import Map, Measurement
from planish.registration.texture.lowpass import EVERYWHERE, bell

#: Blocks [px] at which everything that belongs to the pattern's statistics is kept.
BLOCK_PX = 4
#: The variance of a contrast is averaged with a Gaussian of this deviation [blocks].
_VARIANCE_BLOCKS = 2.0
#: Standard deviation of the Gaussian that parts the bands [px].
_SPLIT_PX = 1.0
#: It ends there.
_SPLIT_REACH_PX = 4
#: Share of the variance of white noise in the fine and the coarse band: |delta - g|^2 and |g|^2 of that Gaussian.
BAND_NOISE = (1 - 2 / (2 * np.pi * _SPLIT_PX**2) + 1 / (4 * np.pi * _SPLIT_PX**2), 1 / (4 * np.pi * _SPLIT_PX**2))
#: Pixels per independent value of white noise in each band: sum of the squared autocorrelation, exp(-d^2 / 4 s^2).
BAND_CELLS_PX = (1.0, 2 * np.pi * _SPLIT_PX**2)
#: Contrasts are never weighted as if they varied less than this (rms).
_MIN_DEVIATION = 1e-4


@dataclass(frozen=True)
class BandPattern:
    """The relative gain of one camera's pixels in one band: sums over captures, and what is known of it beforehand.

    The sums are kept, not the gain, so that each capture can be corrected by all the others: its own texture and noise
    stay out of its correction.

    Parameters
    ----------
    weighted_sum, weight : ndarray (H, W) float32
        Sum over captures of contrast / variance and 1 / variance.
    prior : ndarray (h, w) float32
        Variance of the pattern around each block.
    still : ndarray (h, w) float32
        Variance of texture that stood still, too: background, repeated captures of one place.
    gain : ndarray (h, w) float32
        Information per `weight`, which counts the pattern itself as noise.
    """

    weighted_sum: Map
    weight: Map
    prior: Map
    still: Map
    gain: Map

    def remove(self, band: Map, own: Map | None, rest: Map, uncertain: Map, threads: int) -> None:
        """Take the pattern in a band (H, W) of a contrast from `rest`; `uncertain` grows by what stays uncertain of it.

        `own` (h, w) are the weights with which the contrast took part in the sums, None where it did not.
        """
        knowledge = self.weighted_sum, self.weight, self.prior, self.still, self.gain
        # The bands overlap: of a white pattern they hold this share of the variance, the rest is their covariance.
        share = 1 / sum(BAND_NOISE)
        nothing = np.empty((0, 0), np.float32)
        _core.remove_pattern(
            band, nothing if own is None else own, knowledge, BLOCK_PX, share, rest, uncertain, threads
        )


@dataclass(frozen=True)
class CameraPattern:
    """The pattern of one camera: a fine and a coarse band, of which texture hides the coarse one more."""

    bands: tuple[BandPattern, BandPattern]

    def remove(self, value: Map, variance: Map, counted: Map | None, threads: int) -> tuple[Map, Map]:
        """Return contrast and variance (H, W) without the pattern; what stays uncertain of it is added to the variance.

        `counted` (h, w) tells the blocks with which the contrast took part in the estimate, None where it did not.
        """
        rest, uncertain = value.copy(), variance.copy()
        for part, band in zip(split_bands(value, threads), self.bands, strict=True):
            own = None if counted is None else pattern_weights(part.squares, part.count) * counted
            band.remove(part.value, own, rest, uncertain, threads)
        return rest, uncertain

    def estimate(self, threads: int = 1) -> tuple[Map, Map]:
        """Return relative gain - 1 by all captures together, and its standard deviation, each (H, W)."""
        nothing = np.zeros_like(self.bands[0].weight)
        value, variance = self.remove(nothing, nothing, None, threads)
        return -value, np.sqrt(variance)


@dataclass(frozen=True)
class FixedPattern:
    """The patterns of the cameras of one sensor, and the names of the captures they were estimated from."""

    cameras: Mapping[str, CameraPattern]
    members: frozenset[str]

    def remove(self, measurement: Measurement, camera: str, value: Map, variance: Map, threads: int) -> tuple[Map, Map]:
        """Return contrast and variance (H, W) of a measurement's camera without the pattern."""
        if camera not in self.cameras:
            return value, variance
        counted = counted_blocks(measurement, camera) if measurement.name in self.members else None
        return self.cameras[camera].remove(value, variance, counted, threads)


@dataclass(frozen=True)
class Band:
    """One band of a contrast (H, W); sum of squares and number (h, w) of its known pixels per block."""

    value: Map
    squares: Map
    count: Map


def split_bands(value: Map, threads: int) -> tuple[Band, Band]:
    """Return the fine and the coarse band of a contrast (H, W); NaN stays where it is.

    What is fixed to the pixels is white, texture comes through a lens: the fine part holds most of the pattern and
    little texture.
    """
    fine, coarse, fine_squares, coarse_squares, count = _core.split_bands(
        value, bell(_SPLIT_PX, _SPLIT_REACH_PX).tolist(), BLOCK_PX, threads
    )
    return Band(fine, fine_squares, count), Band(coarse, coarse_squares, count)


def block_moments(value: Map, threads: int) -> tuple[Map, Map]:
    """Return sum of squares and number (h, w) of the known pixels of a map (H, W) per block."""
    return _core.block_sums(value * value, -np.inf, np.inf, EVERYWHERE, BLOCK_PX, threads)


def pattern_weights(squares: Map, count: Map) -> Map:
    """Return 1 / variance (h, w) of a contrast around each block by its moments: texture, pattern, noise together."""
    squares, count = (
        cv2.GaussianBlur(m, (0, 0), _VARIANCE_BLOCKS, borderType=cv2.BORDER_CONSTANT) for m in (squares, count)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.maximum(squares / count, np.float32(_MIN_DEVIATION**2))
        weights = np.where(count > 0, 1 / variance, np.float32(0))
    return np.asarray(weights, np.float32)


def counted_blocks(measurement: Measurement, camera: str) -> Map:
    """Return 1 for the blocks (h, w) of a camera that see measured points, 0 for the rest.

    Of what holds no points nobody knows whether it stood still.
    """
    width, height = measurement.rig.cameras[camera].size_px
    shape = (-(-height // BLOCK_PX), -(-width // BLOCK_PX))
    if camera == measurement.organised_on:
        hit = np.pad(measurement.valid, [(0, n * BLOCK_PX - m) for n, m in zip(shape, (height, width), strict=True)])
        return np.asarray(hit.reshape(shape[0], BLOCK_PX, shape[1], BLOCK_PX).any((1, 3)), np.float32)
    assert measurement.correspondence_px is not None
    places = measurement.correspondence_px[::BLOCK_PX, ::BLOCK_PX].reshape(-1, 2)
    places = places[np.isfinite(places[:, 0])]
    column, row = ((places[:, i].clip(0, n - 1) / BLOCK_PX).astype(np.intp) for i, n in enumerate((width, height)))
    hit = np.zeros(shape, np.float32)
    hit[row, column] = 1
    # The samples are a block apart, give or take the perspective.
    return cv2.dilate(hit, np.ones((3, 3), np.uint8))
