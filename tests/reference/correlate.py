"""NumPy twin of the temporal correlation: brute force over the curve, written from the definitions."""

from __future__ import annotations

import numpy as np


def unit_vectors(images):
    """Vectors (H, W, N) of unit length and mean zero over time, from images (N, H, W)."""
    values = np.moveaxis(np.asarray(images, float), 0, -1)
    values = values - values.mean(-1, keepdims=True)
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def weights(fraction):
    """Weights (8,) of the pixels at -3 ... 4: cubic B-spline of coefficients 1 + y + y^2, y = (-1, 2, -1) / 6."""
    y, one = np.array([-1, 2, -1]) / 6, np.array([0, 0, 1, 0, 0])
    prefilter = one + np.pad(y, 1) + np.convolve(y, y)
    nodes = np.abs(np.arange(-1, 3) - fraction)
    inner, outer = 2 / 3 - nodes**2 + nodes**3 / 2, (2 - nodes) ** 3 / 6
    return np.convolve(np.where(nodes < 1, inner, np.where(nodes < 2, outer, 0)), prefilter)


def interpolate(vectors, u, v):
    """Vector (N,) at a place between the pixels."""
    left, top = int(np.floor(u)), int(np.floor(v))
    window = vectors[top - 3 : top + 5, left - 3 : left + 5]
    return np.einsum("i,j,ijn->n", weights(v - top), weights(u - left), window)


def best_correlation(own_images, other_images, own, other, u, v, step_px=0.05):
    """Place (2,) of the highest correlation on the epipolar curve of pixel (u, v), and that correlation."""
    a, b = unit_vectors(own_images)[v, u], unit_vectors(other_images)
    height, width = b.shape[:2]
    direction = own.rays_sensor(np.array([u, v], float))
    curve = other.project(own.center_sensor + np.geomspace(100, 20000, 20000)[:, None] * direction)
    curve = curve[np.isfinite(curve[:, 0])]
    curve = curve[np.argsort(curve[:, 0])]
    columns = np.arange(3, width - 5, step_px)
    rows = np.interp(columns, curve[:, 0], curve[:, 1])
    inside = (rows >= 3) & (rows < height - 5) & (columns >= curve[0, 0]) & (columns <= curve[-1, 0])
    columns, rows = columns[inside], rows[inside]
    found = np.array([interpolate(b, x, y) for x, y in zip(columns, rows, strict=True)])
    score = found @ a / np.linalg.norm(found, axis=1)
    i = int(np.clip(np.argmax(score), 1, len(score) - 2))
    below, above = score[i] - score[i - 1], score[i] - score[i + 1]
    shift = 0.5 * (below - above) / (below + above)
    return np.array([columns[i] + shift * step_px, rows[i] + shift * (rows[i + 1] - rows[i])]), score[i]
