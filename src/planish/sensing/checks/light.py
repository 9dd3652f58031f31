"""Two groups of images brought to the same light, so that what is left between them is movement and noise.

Under the share w of the projector's light a camera sees R + w P: R is the room's light on the part, P the projector's.
Where lamps shade the part otherwise than the projector does, images under different shares differ by no common factor,
and steep shading looks like a movement. But the fringes of a group show P by themselves, as their amplitude a P, so
that gain * mean + swing * amplitude is the group under any other share, and under a projector, a lamp or a camera gain
that has changed since. Both factors hold for the whole image: they cannot imitate a movement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.measurement import Map
from planish.sensing.capture.images import GreyImage
from planish.sensing.checks.shift import BLOCK_PX
from planish.sensing.checks.still import BORDER_PX, Still

#: A block tells the light where this share of its pixels counts.
BLOCK_SHARE = 0.5


@dataclass(frozen=True)
class Band:
    """Some rows of two groups of images.

    Parameters
    ----------
    first, last : ndarray (h, W) float32
        Mean grey values.
    amplitude : ndarray (h, W) float32 or None
        Of the patterns of the group that is brought to the light of the other.
    usable : ndarray (h, W) uint8
        1 where both groups can be compared, else 0.
    """

    first: Map
    last: Map
    amplitude: Map | None
    usable: NDArray[np.uint8]


@dataclass(frozen=True)
class EqualLight:
    """How the group `of` is brought to the light of the other one: gain * mean + swing * amplitude."""

    of: Still | None = None
    gain: float = 1.0
    swing: float = 0.0

    def means(self, band: Band, first: Still) -> tuple[Map, Map]:
        """Return the means (h, W) of first and last under the same light."""
        if self.of is None or band.amplitude is None:
            return band.first, band.last
        own = band.first if self.of is first else band.last
        lit = np.float32(self.gain) * own + np.float32(self.swing) * band.amplitude
        return (lit, band.last) if self.of is first else (band.first, lit)

    def share(self, still: Still) -> float:
        """Return the variance of a group's mean under that light, in units of that of a single image."""
        count = len(still.images)
        if self.of is not still:
            return 1 / count
        parts = sum((len(swing.images) / count) ** 2 * swing.share for swing in still.swings)
        return self.gain**2 / count + self.swing**2 * parts


def to_adapt(first: Still, last: Still) -> Still | None:
    """Return which of two groups is brought to the light of the other: the darker one that shows patterns."""
    return min((still for still in (first, last) if still.swings), key=lambda still: still.light, default=None)


def amplitude_of(images: Sequence[GreyImage], still: Still, rows: slice) -> tuple[Map, NDArray[np.uint8]]:
    """Return the amplitude (h, W) of the patterns of a group, and where (h, W) it is known, 1 or 0.

    It is not at the borders of Gray cells, which the lens blurs.
    """
    shape = images[0][rows].shape
    total, known = np.zeros(shape, np.float32), np.ones(shape, np.uint8)
    for swing in still.swings:
        cosine, sine = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for index, c, s in zip(swing.images, swing.cosine, swing.sine, strict=True):
            grey = images[index][rows].astype(np.float32)
            cosine += np.float32(c) * grey
            sine += np.float32(s) * grey
        total += np.float32(len(swing.images) / len(still.images)) * cv2.magnitude(cosine, sine)
        if swing.in_cells:
            lit, kernel = (cosine > 0).view(np.uint8), np.ones((2 * BORDER_PX + 1, 2 * BORDER_PX + 1), np.uint8)
            known &= cv2.erode(lit, kernel) | (1 - cv2.dilate(lit, kernel))
    return total, known


def equal_light(bands: Sequence[Band], first: Still, last: Still) -> EqualLight:
    """Return how two groups come under the same light, by least squares of the means of blocks.

    Notes
    -----
    Means of blocks have next to no noise, which would bias the factors. They are relative to the brightness, as are the
    differences that a local ratio of brightness leaves. Where all blocks tell the same (no room light, even shading),
    the shortest of all solutions is as good as any.
    """
    of = to_adapt(first, last)
    if of is None:
        return EqualLight()
    rows = [row for band in bands for row in _block_means(band)]
    if not rows:
        return EqualLight()
    count, means = np.array([row[0] for row in rows]), np.array([row[1:] for row in rows])
    own, other = (means[:, 0], means[:, 1]) if of is first else (means[:, 1], means[:, 0])
    weight = np.sqrt(count) / np.maximum(other, 1e-3)
    amplitude = means[:, 2]
    left = np.column_stack([own, amplitude]) * weight[:, None]
    change = np.linalg.lstsq(left, (other - own) * weight, rcond=1e-6)[0]
    return EqualLight(of, 1 + float(change[0]), float(change[1]))


def _block_means(band: Band) -> list[tuple[float, float, float, float]]:
    """Return the number of usable pixels of blocks, and their means of first, last and amplitude."""
    assert band.amplitude is not None
    height, width = (max(n // BLOCK_PX, 1) for n in band.first.shape)
    count = _block_sums(band.usable.astype(np.float32), height, width)
    tells = count > BLOCK_SHARE * BLOCK_PX**2
    sums = [_block_sums(band.usable * image, height, width) for image in (band.first, band.last, band.amplitude)]
    return [
        (float(n), float(a / n), float(b / n), float(c / n))
        for n, a, b, c in zip(count[tells], *(image[tells] for image in sums), strict=True)
    ]


def _block_sums(image: Map, height: int, width: int) -> Map:
    inner = image[: height * BLOCK_PX, : width * BLOCK_PX]
    mean = cv2.resize(inner, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(mean * np.float32(BLOCK_PX**2), np.float32)
