"""Mean of some images of a sequence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from planish.measurement import Map
from planish.sensing.capture.images import GreyImage


def mean_image(images: Sequence[GreyImage], indices: Sequence[int]) -> Map:
    """Return the mean (H, W) float32 of the images with these indices (at least one)."""
    total = images[indices[0]].astype(np.float32)
    for index in indices[1:]:
        total += images[index]
    if len(indices) > 1:
        total /= np.float32(len(indices))
    return total
