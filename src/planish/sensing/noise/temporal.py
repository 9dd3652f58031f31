"""Noise of statistical patterns: what a pixel's grey values over time do not share with those of its neighbours.

The pattern is nearly the same in three neighbouring pixels; the texture is a gain, other light an offset. So the grey
values of the middle pixel over time are a line of the mean of both beside it, but for the noise of all three.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from planish.sensing.capture.images import GreyImage

Samples = NDArray[np.float32]

#: Image lines that are looked at (in groups of three), and every so many pixels of them.
SAMPLED_LINES, STRIDE = 120, 3


def temporal_samples(images: Sequence[GreyImage], saturation: float) -> tuple[Samples, Samples]:
    """Return grey levels (n,) and residuals (n,) with the variance of a single grey value.

    Neighbours are taken along columns and along rows, and those count that leave less: a pattern changes less along
    its stripes.

    Parameters
    ----------
    images : sequence of ndarray (H, W)
        Those of the patterns, more than two.
    saturation : float
        Pixels that reach this grey level in any image are left out.
    """
    found = [_along(images, axis, saturation) for axis in (0, 1)]
    return min(found, key=lambda sample: float(np.median(np.abs(sample[1]))) if len(sample[1]) else np.inf)


def _along(images: Sequence[GreyImage], axis: int, saturation: float) -> tuple[Samples, Samples]:
    length = images[0].shape[axis]
    starts = np.unique(np.linspace(0, max(length - 3, 0), SAMPLED_LINES // 3).astype(int))
    across = [slice(None, None, STRIDE)] * 2

    def line(offset: int) -> NDArray[np.float64]:
        across[axis] = np.minimum(starts + offset, length - 1)
        return np.stack([image[tuple(across)].ravel() for image in images]).astype(float)

    before, here, after = line(0), line(1), line(2)
    lit = np.maximum(np.maximum(before, here), after).max(0) < saturation
    here, beside = here[:, lit], 0.5 * (before + after)[:, lit]
    steps = len(images)
    x, y = beside - beside.mean(0), here - here.mean(0)
    gain = (x * y).sum(0) / np.maximum((x * x).sum(0), 1e-9)
    # Two numbers are fitted to `steps`; the residual holds the noise of one value and of the mean of two.
    residual = (y - gain * x) / np.sqrt((1 - 2 / steps) * (1 + gain**2 / 2))
    return beside.ravel().astype(np.float32), residual.ravel().astype(np.float32)
