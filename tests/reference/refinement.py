"""Twins of the kernels that make the refinement's maps."""

from __future__ import annotations

import numpy as np


def window_moments(image, taps, pairs, step, shape):
    """Sums (pairs, h, w) of an image under taps[p] along u times taps[q] along v around every n-th pixel."""
    reach = len(taps[0]) // 2
    padded = np.pad(image.astype(float), reach + step)[step:, step:]
    out = np.zeros((len(pairs), *shape))
    for k, (p, q) in enumerate(pairs):
        window = np.outer(taps[q], taps[p])
        for i, j in np.ndindex(*shape):
            out[k, i, j] = (padded[i * step :, j * step :][: len(window), : len(window)] * window).sum()
    return out


def spectrum_cells(power, step):
    """Averages of a whole spectrum (h, w) under triangles around every n-th frequency, half of them."""
    out = np.zeros((power.shape[0] // step, power.shape[1] // step))
    for dv in range(1 - step, step):
        for du in range(1 - step, step):
            weight = (1 - abs(dv) / step) * (1 - abs(du) / step) / step**2
            out += weight * np.roll(power, (-dv, -du), (0, 1))[::step, ::step]
    return out[:, : power.shape[1] // 2 // step + 1]
