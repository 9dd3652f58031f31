"""The grey values a sensor can give: where they end, and how far apart they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planish.sensing.capture.images import GreyImage

#: Full scales of sensors, also of 10, 12 and 14 bit in files of 16 bit (low or high bits used).
FULL_SCALES = (255, 1023, 4095, 16383, 65472, 65520, 65532, 65535)
#: A sensor that ends below full scale shows so many times more pixels at its highest level than at the mean of the
#: TAIL levels below. The crest of noise-free fringes on a uniform surface, the steepest that light makes, shows 2.6.
MIN_SPIKE, TAIL = 6.0, 8
#: Fewer pixels at the highest level are no evidence.
MIN_PIXELS = 50
#: Grey values that are looked at for the distance of levels, and how many of their gaps must be as small.
SAMPLES, MIN_GAPS = 20000, 0.5


@dataclass(frozen=True)
class GreyRange:
    """`saturation`: the level at and above which a pixel is saturated; `step`: distance of neighbouring levels."""

    saturation: float
    step: int


def grey_range(fringes: Sequence[GreyImage], images: Sequence[GreyImage]) -> GreyRange:
    """Return the range of grey values of a camera.

    Parameters
    ----------
    fringes : sequence of ndarray (H, W)
        Those that show a continuous range of light, by which a cut is known; may be empty.
    images : sequence of ndarray (H, W)
        All images, of one type.
    """
    step = _step(images)
    if images[0].dtype == np.uint8:
        scale = 255.0
    else:
        brightest = max(int(image.max()) for image in images)
        scale = float(next(level for level in FULL_SCALES[1:] if level >= brightest))
    highest = max((int(image.max()) for image in fringes), default=0)
    return GreyRange(float(highest) if 0 < highest < scale and _is_cut(fringes, highest, step) else scale, step)


def _is_cut(fringes: Sequence[GreyImage], highest: int, step: int) -> bool:
    at = sum(np.count_nonzero(image > highest - step) for image in fringes)
    if at < MIN_PIXELS:
        return False
    # The tail may hold fewer levels than TAIL: light below black is no light.
    levels = min(TAIL, highest // step)
    below = sum(np.count_nonzero(image > highest - (levels + 1) * step) for image in fringes) - at
    return bool(at > MIN_SPIKE * max(below, 1) / max(levels, 1))


def _step(images: Sequence[GreyImage]) -> int:
    """Return the distance of neighbouring grey levels: 16 where 12 bits stand in the high bits of 16."""
    # The brightest of some images, so that not all of them are dark.
    each = max(1, SAMPLES // len(images))
    values = np.concatenate([image.ravel()[:: max(1, image.size // each)] for image in images])
    levels = np.flatnonzero(np.bincount(values))
    gaps = np.diff(levels)
    if len(gaps) < TAIL:
        return 1
    # Bits that are filled up with a copy of the highest ones make gaps of one more now and then.
    least = int(gaps.min())
    return least if np.mean(gaps <= least + 1) >= MIN_GAPS else 1
