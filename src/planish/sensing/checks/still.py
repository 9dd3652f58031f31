"""Which images of a sequence show the same picture, so that the first of them can be compared with the last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.measurement import Map
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import AxisCode, Layout, PeriodSteps

#: Groups are joined with their neighbours in time until they hold so many images: less noise.
JOINED_IMAGES = 4
#: Lit cells of a Gray bit are compared where they make the time between first and last so many times longer.
LONGER = 1.5
#: Lit cells show more than this share of the projector's full light.
LIT_LEVEL = 0.6
#: Pixels beside the border of a lit cell, where lens and projector blur it.
BORDER_PX = 2


@dataclass(frozen=True)
class Swing:
    """Images that show the projector's light by itself: hypot(cosine . I, sine . I), whatever the room adds.

    Parameters
    ----------
    images : tuple of int
        Indices in the sequence.
    cosine, sine : tuple of float
        A weight per image.
    pattern : "fringes", "cells" or "none"
        What they show: steps of fringes, a Gray bit and its inverse, or white and black. Of light that comes by several
        ways patterns show less; white and black show all of it.
    """

    images: tuple[int, ...]
    cosine: tuple[float, ...]
    sine: tuple[float, ...]
    pattern: Literal["fringes", "cells", "none"]

    @classmethod
    def of_fringes(cls, steps: PeriodSteps) -> Swing:
        """Return that of the steps of one period, whose amplitude is half of the light."""
        scale = 4 / len(steps.images)
        return cls(steps.images, tuple(scale * np.cos(steps.angles)), tuple(scale * np.sin(steps.angles)), "fringes")

    @classmethod
    def between(cls, lit: int, unlit: int, pattern: Literal["cells", "none"]) -> Swing:
        """Return that of two images."""
        return cls((lit, unlit), (1.0, -1.0), (0.0, 0.0), pattern)

    @property
    def share(self) -> float:
        """Variance of the light in units of that of an image; of fringes the mean over all phases."""
        power = float(np.square(self.cosine).sum() + np.square(self.sine).sum())
        return power / 2 if self.pattern == "fringes" else power


@dataclass(frozen=True)
class Still:
    """Images in whose mean the patterns cancel.

    Parameters
    ----------
    images : tuple of int
        Indices in the sequence.
    name : str
        In words.
    lit_only : bool
        True where only the lit cells of a Gray bit can be compared.
    light : float
        Share of the projector's light in their mean.
    swings : tuple of Swing
        What shows the projector's light by itself.
    """

    images: tuple[int, ...]
    name: str
    lit_only: bool = False
    light: float = 0.5
    swings: tuple[Swing, ...] = ()

    @property
    def time(self) -> float:
        """Mean place in the sequence."""
        return float(np.mean(self.images))

    @property
    def blank(self) -> bool:
        """Whether it shows no patterns: white."""
        return not self.lit_only and self.light == 1.0

    @property
    def exact_swings(self) -> tuple[Swing, ...]:
        """Those swings that show all of the projector's light."""
        return tuple(swing for swing in self.swings if swing.pattern == "none")

    @property
    def needed(self) -> tuple[int, ...]:
        """All images that it refers to."""
        return tuple(dict.fromkeys(self.images + tuple(i for swing in self.swings for i in swing.images)))

    def renumbered(self, places: Mapping[int, int]) -> Still:
        """Return the group with other indices: image k is at places[k]."""
        swings = tuple(replace(swing, images=tuple(places[i] for i in swing.images)) for swing in self.swings)
        return replace(self, images=tuple(places[i] for i in self.images), swings=swings)


def stills(layouts: Sequence[Layout]) -> list[Still]:
    """Return all groups of images that show the scene without patterns, in the order of time."""
    found: list[Still] = []
    for layout in layouts:
        for code in layout.codes:
            found += [
                Still(p.images, f"the fringes of {p.period_px:g} px", swings=(Swing.of_fringes(p),))
                for p in code.periods
            ]
            found += _gray_stills(code)
        found += [Still((i,), "white", light=1.0, swings=_white_swing(i, layout.black)) for i in layout.white]
    return sorted(found, key=lambda still: still.time)


def _white_swing(white: int, black: Sequence[int]) -> tuple[Swing, ...]:
    nearest = min(black, key=lambda index: abs(index - white), default=None)
    return () if nearest is None else (Swing.between(white, nearest, "none"),)


def _gray_stills(code: AxisCode) -> list[Still]:
    if code.gray is None:
        return []
    bits = range(len(code.gray.images) - 1, -1, -1)
    found = []
    for bit, index, inverse in zip(bits, code.gray.images, code.gray.inverse, strict=True):
        if inverse >= 0:
            swing = Swing.between(index, inverse, "cells")
            found.append(Still((index, inverse), f"Gray bit {bit} of {code.axis}", swings=(swing,)))
        else:
            found.append(Still((index,), f"the lit cells of Gray bit {bit}", True, 1.0))
    return found


def to_compare(found: Sequence[Still]) -> list[tuple[Still, Still]]:
    """Return the pairs (first, last) of groups to be compared, the one that spans most of the time first.

    Lit cells cover half of the image only: of two Gray bits nothing would be left, and fine cells hold no texture.
    """
    patterns = [still for still in found if not still.lit_only and not still.blank]
    # Under equal light where that is possible.
    whole = patterns if len(patterns) > 1 else [still for still in found if not still.lit_only]
    if not whole:
        return []
    first, last = whole[0], whole[-1]
    span = last.time - first.time
    pairs = []
    # Bits are shown from the coarsest to the finest: the first one before the fringes, or after them, counts.
    before = [s for s in found if s.lit_only and s.time < first.time][:1]
    after = [s for s in found if s.lit_only and s.time > last.time][:1]
    if before and last.time - before[0].time > LONGER * span:
        pairs.append((before[0], last))
    elif after and after[0].time - first.time > LONGER * span:
        pairs.append((first, after[0]))
    if last is not first:
        pairs.append((_joined(whole, 1), _joined(whole[::-1], -1)))
    return pairs


def white_to_compare(found: Sequence[Still]) -> tuple[Still, Still] | None:
    """Return (first, last): white and the patterns nearest to it in time, where `to_compare` leaves white out.

    It is the white image that lies farthest from all patterns.
    """
    patterns = [still for still in found if not still.lit_only and not still.blank]
    whites = [still for still in found if still.blank]
    if len(patterns) < 2 or not whites:
        return None
    white = max(whites, key=lambda still: min(abs(still.time - other.time) for other in patterns))
    near = min(patterns, key=lambda other: abs(white.time - other.time))
    return (near, white) if near.time < white.time else (white, near)


def _joined(groups: Sequence[Still], direction: int) -> Still:
    joined = groups[0]
    # At most half of the groups: first and last have to differ.
    for group in groups[1 : len(groups) // 2]:
        if len(joined.images) >= JOINED_IMAGES:
            break
        parts = (joined, group)[::direction]
        images = parts[0].images + parts[1].images
        light = sum(part.light * len(part.images) for part in parts) / len(images)
        name, swings = _span(parts[0].name, parts[1].name), parts[0].swings + parts[1].swings
        joined = Still(images, name, light=light, swings=swings)
    return joined


def mean_of(images: Sequence[GreyImage], indices: Sequence[int], rows: slice) -> Map:
    """Return the mean (rows, W) of some images."""
    total = np.zeros(images[0][rows].shape, np.float32)
    for index in indices:
        cv2.accumulate(images[index][rows], total)
    total *= np.float32(1 / len(indices))
    return total


def projector_light(images: Sequence[GreyImage], still: Still, rows: slice) -> tuple[Map, NDArray[np.uint8]] | None:
    """Return the projector's full light (h, W) as a group shows it, and where (h, W) it is known, 1 or 0.

    It is not at the borders of Gray cells, which the lens blurs. None where the group does not show it.
    """
    swings, shape = still.exact_swings or still.swings, images[0][rows].shape
    if not swings:
        return None
    total, known = np.zeros(shape, np.float32), np.ones(shape, np.uint8)
    for swing in swings:
        cosine, sine = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for index, c, s in zip(swing.images, swing.cosine, swing.sine, strict=True):
            grey = images[index][rows].astype(np.float32)
            cosine += np.float32(c) * grey
            sine += np.float32(s) * grey
        total += cosine if swing.pattern == "none" else cv2.magnitude(cosine, sine)
        if swing.pattern == "cells":
            lit, kernel = (cosine > 0).view(np.uint8), np.ones((2 * BORDER_PX + 1, 2 * BORDER_PX + 1), np.uint8)
            known &= cv2.erode(lit, kernel) | (1 - cv2.dilate(lit, kernel))
    return total / np.float32(len(swings)), known


def comparable(
    images: Sequence[GreyImage], first: Still, last: Still, means: tuple[Map, Map], rows: slice, contrast: float,
    saturation: float,
) -> NDArray[np.uint8]:  # fmt: skip
    """Return where (rows, W) two groups can be compared, 1 or 0: lit by the projector, nowhere saturated."""
    indices = first.images + last.images
    high, low = images[indices[0]][rows], images[indices[0]][rows]
    for index in indices[1:]:
        high, low = cv2.max(high, images[index][rows]), cv2.min(low, images[index][rows])
    usable = (cv2.subtract(high, low) > contrast) & (high < saturation)
    counts = usable.view(np.uint8)
    for still, own, other, of in ((first, *means, last), (last, *means[::-1], first)):
        if still.lit_only:
            shown = projector_light(images, of, rows)
            # Without word of the projector's own light all of it is taken for that.
            light = other / np.float32(of.light) if shown is None else shown[0]
            lit = (own > other + np.float32(LIT_LEVEL - of.light) * light).view(np.uint8)
            size = 2 * BORDER_PX + 1
            counts = counts & cv2.erode(lit, np.ones((size, size), np.uint8))
    return np.asarray(counts, np.uint8)


def _span(first: str, last: str) -> str:
    return f"{first.split(' to ')[0]} to {last.split(' to ')[-1]}"
