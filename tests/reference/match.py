"""NumPy twin of the exhaustive descriptor matching."""

from __future__ import annotations

import numpy as np


def nearest(a, size_a, b, size_b, max_size_ratio):
    """Per row of a: nearest row of b of fitting size (-1 = none), its squared distance, that of the second nearest."""
    none = np.iinfo(np.int32).max
    out = np.tile([-1, none, none], (len(a), 1))
    for i, (row, size) in enumerate(zip(a.astype(int), size_a, strict=True)):
        fits = np.flatnonzero(np.maximum(size / size_b, size_b / size) <= max_size_ratio)
        squared = ((b[fits].astype(int) - row) ** 2).sum(1)
        order = np.argsort(squared, kind="stable")
        if len(order) > 0:
            out[i, :2] = fits[order[0]], squared[order[0]]
        if len(order) > 1:
            out[i, 2] = squared[order[1]]
    return out
