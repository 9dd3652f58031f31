"""Two groups of images brought to the same light, so that what is left between them is movement and noise.

Under the share w of the projector's light a camera sees R + w P: R is the room's light on the part, P the projector's.
Where lamps shade the part otherwise than the projector does, images under different shares differ by no common factor,
and steep shading looks like a movement. But a group that shows P by itself, as white less black or as the amplitude of
its fringes, gives gain * mean + swing * P: itself under any other share, and under a projector, a lamp or a camera gain
that has changed since. Both factors hold for the whole image: they cannot imitate a movement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map
from planish.sensing.checks.shift import BLOCK_PX
from planish.sensing.checks.still import Still

#: A block tells the light where this share of its pixels counts.
BLOCK_SHARE = 0.5


@dataclass(frozen=True)
class Band:
    """Some rows of two groups of images.

    Parameters
    ----------
    first, last : ndarray (h, W) float32
        Mean grey values.
    light : ndarray (h, W) float32 or None
        The projector's light, as the group shows it that is brought to the light of the other.
    usable : ndarray (h, W) uint8
        1 where both groups can be compared, else 0.
    """

    first: Map
    last: Map
    light: Map | None
    usable: NDArray[np.uint8]


@dataclass(frozen=True)
class EqualLight:
    """How one of two groups comes under the light of the other one: gain * mean + swing * projector's light.

    Parameters
    ----------
    of : "first", "last" or None
        Which one; None where both stay as they are.
    gain, swing : float
        The two factors.
    """

    of: Literal["first", "last"] | None = None
    gain: float = 1.0
    swing: float = 0.0

    def means(self, band: Band) -> tuple[Map, Map]:
        """Return the means (h, W) of first and last under the same light."""
        if self.of is None or band.light is None:
            return band.first, band.last
        own = band.first if self.of == "first" else band.last
        lit = np.float32(self.gain) * own + np.float32(self.swing) * band.light
        return (lit, band.last) if self.of == "first" else (band.first, lit)

    def shares(self, first: Still, last: Still) -> tuple[float, float]:
        """Return the variances of both means under that light, in units of that of a single image."""
        found = [1 / len(still.images) for still in (first, last)]
        if self.of is not None:
            found[self.of == "last"] = self._share(first if self.of == "first" else last)
        return found[0], found[1]

    def _share(self, still: Still) -> float:
        swings = still.exact_swings or still.swings
        weights, patterns = dict.fromkeys(still.needed, 0.0), 0.0
        for index in still.images:
            weights[index] += self.gain / len(still.images)
        for swing in swings:
            scale = self.swing / len(swings)
            if swing.pattern == "none":
                for index, weight in zip(swing.images, swing.cosine, strict=True):
                    weights[index] += scale * weight
            else:
                # With the phase, or from cell to cell, the weights change their sign: no correlation with the mean.
                patterns += scale**2 * swing.share
        return sum(weight**2 for weight in weights.values()) + patterns


def to_adapt(first: Still, last: Still) -> Still | None:
    """Return which of two groups is brought to the light of the other: that which shows the projector's light best.

    Of groups that show it equally well the darker one: light is better added than taken off.
    """
    groups = [still for still in (first, last) if still.swings]
    return min(groups, key=lambda still: (not still.exact_swings, still.light), default=None)


def equal_light(bands: Sequence[Band], first: Still, last: Still) -> EqualLight:
    """Return how two groups come under the same light, by least squares of the means of blocks.

    Notes
    -----
    Means of blocks have next to no noise, which would bias the factors. They are relative to the brightness, as are the
    differences that a local ratio of brightness leaves. Where all blocks tell the same (no room light, even shading),
    the shortest of all solutions is as good as any.
    """
    of = to_adapt(first, last)
    means = np.concatenate([_block_means(band) for band in bands])
    if of is None or not len(means):
        return EqualLight()
    own, other = (means[:, 1], means[:, 2]) if of is first else (means[:, 2], means[:, 1])
    weight = np.sqrt(means[:, 0]) / np.maximum(other, 1e-3)
    columns = np.column_stack([own, means[:, 3]]) * weight[:, None]
    change = np.linalg.lstsq(columns, (other - own) * weight, rcond=1e-6)[0]
    return EqualLight("first" if of is first else "last", 1 + float(change[0]), float(change[1]))


def _block_means(band: Band) -> Array:
    """Return (n, 4): the usable pixels of blocks, and the means over them of first, last and the projector's light."""
    height, width = (max(n // BLOCK_PX, 1) for n in band.first.shape)
    maps = (band.first, band.last, np.zeros_like(band.first) if band.light is None else band.light)
    sums = [_block_sums(band.usable * image, height, width) for image in (np.ones_like(band.first), *maps)]
    tells = sums[0] > BLOCK_SHARE * BLOCK_PX**2
    count = sums[0][tells].astype(float)
    return np.column_stack([count, *(total[tells] / count for total in sums[1:])])


def _block_sums(image: Map, height: int, width: int) -> Map:
    inner = image[: height * BLOCK_PX, : width * BLOCK_PX]
    mean = cv2.resize(inner, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(mean * np.float32(BLOCK_PX**2), np.float32)
