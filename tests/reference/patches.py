"""NumPy twin of the comparison of patches: correlation of two discs, sampled linearly, at given turns and offsets."""

from __future__ import annotations

import numpy as np


def sample(chart, place, offsets):
    """Values (...) of a chart (h, w) at place [u, v, axes row by row] + axes @ offsets (..., 2); 0 outside."""
    u, v = np.moveaxis(place[:2] + offsets @ place[2:].reshape(2, 2).T, -1, 0)
    height, width = chart.shape
    inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    iu, iv = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    fu, fv = u - iu, v - iv
    top = (1 - fu) * chart[iv, iu] + fu * chart[iv, iu + 1]
    bottom = (1 - fu) * chart[iv + 1, iu] + fu * chart[iv + 1, iu + 1]
    return np.where(inside, (1 - fv) * top + fv * bottom, 0)


def correlation(chart_a, place_a, chart_b, place_b, radius, x, y, turn):
    """Normalised correlation and number of pixels of the disc of a at offset (x, y), turned by `turn`, in b."""
    grid = np.stack(np.meshgrid(*2 * [np.arange(-radius, radius + 1)]), axis=-1).astype(float)
    disc = grid[(grid**2).sum(-1) <= radius**2]
    c, s = np.cos(turn), np.sin(turn)
    a = sample(chart_a, place_a, disc @ np.array([[c, -s], [s, c]]))  # rows times matrix: turned back
    b = sample(chart_b, place_b, disc + [x, y])
    both = (a != 0) & (b != 0)
    norm = np.sqrt((a[both] ** 2).sum() * (b[both] ** 2).sum())
    return (a * b).sum() / norm if norm > 0 else -1.0, int(both.sum())
