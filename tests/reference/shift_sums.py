"""Sums of a gradient least squares between two images, by whole-array operations."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

BLOCK, REACH = 16, 3


def _local_mean(image, usable):
    rows, columns = (max(1, n // BLOCK) for n in image.shape)

    def blocks(a):
        total = a[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).sum((1, 3))
        return ndimage.convolve(total, np.ones((3, 3)), mode="constant")

    grid = blocks(image * usable) / np.maximum(blocks(usable.astype(float)), 1)
    v, u = ((np.arange(n) + 0.5) / BLOCK - 0.5 for n in image.shape)
    at = np.meshgrid(np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1), indexing="ij")
    return ndimage.map_coordinates(grid, at, order=1)


def shift_sums(first, last, usable, offset, slope, share_first, share_last):
    """Return the sums (H / 16, W / 16, 12) in the order of the kernel."""
    first, last = first.astype(float), last.astype(float)
    mean_first, mean_last = _local_mean(first, usable), _local_mean(last, usable)
    ratio = mean_first / np.maximum(mean_last, 1e-3)
    x, y = usable * (first - mean_first), usable * ratio * (last - mean_last)
    t, e = 0.5 * (x + y), x - y
    k = np.arange(-REACH, REACH + 1)
    smooth = np.exp(-0.5 * k**2) / np.exp(-0.5 * k**2).sum()
    ramp = smooth * k / (smooth * k * k).sum()

    def filtered(image, along_v, along_u):
        once = ndimage.correlate1d(image, along_v, axis=0, mode="nearest")
        return ndimage.correlate1d(once, along_u, axis=1, mode="constant")

    gu, gv = filtered(t, smooth, ramp), filtered(t, ramp, smooth)
    tt, ee = filtered(t, smooth, smooth), filtered(e, smooth, smooth)
    second = np.array([1.0, -2.0, 1.0])
    corner = ndimage.correlate(t, np.outer(second, second) / 6)
    variance = share_first * (offset + slope * first) + ratio**2 * share_last * (offset + slope * last)
    inner = ndimage.binary_erosion(usable > 0, np.ones((2 * REACH + 1, 2 * REACH + 1)))
    normal = (gu * gu, gu * gv, gu * tt, gv * gv, gv * tt, tt * tt)
    products = (*normal, gu * ee, gv * ee, tt * ee, ee * ee, corner**2, variance)
    rows, columns = (n // BLOCK for n in t.shape)
    cut = [(p * inner)[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK) for p in products]
    return np.stack([c.sum((1, 3)) for c in cut], -1)
