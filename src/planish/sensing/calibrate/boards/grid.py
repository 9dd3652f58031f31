"""The grid of a board's points as an image shows it: its steps and how they bend, its homography."""

from __future__ import annotations

import cv2
import numpy as np

from planish.geometry import Array

#: The shape of the grid around a point is taken from points so many pitches around it: lines bend by lens distortion.
NEIGHBOURS = 2.1


def grid_shape(grid: Array, pixels: Array) -> tuple[Array, Array]:
    """Return first (n, 2, 2) and second derivatives (n, 2, 2) of pixels by the grid's columns and rows, at its points.

    Parameters
    ----------
    grid : ndarray (n, 2)
        Points in pitches.
    pixels : ndarray (n, 2)
        Where they are seen [px].

    Returns
    -------
    slope : ndarray (n, 2, 2)
        d pixel / d (column, row): slope[:, :, 0] is the step to the next column [px].
    bend : ndarray (n, 2, 2)
        Second derivative along the columns (bend[:, :, 0]) and along the rows [px]; 0 where there are too few points.
    """
    slope, bend = np.empty((len(grid), 2, 2)), np.zeros((len(grid), 2, 2))
    whole = polynomial(grid, pixels, 1)
    for k, here in enumerate(grid):
        near = np.abs(grid - here).max(1) < NEIGHBOURS
        d = grid[near] - here
        curved = polynomial(d, pixels[near], 2)
        if curved is not None:
            slope[k], bend[k] = curved[1:3].T, 2 * curved[[3, 5]].T
            continue
        straight = polynomial(d, pixels[near], 1)
        slope[k] = (straight if straight is not None else whole if whole is not None else np.full((3, 2), np.nan))[
            1:3
        ].T
    return slope, bend


def polynomial(x: Array, y: Array, order: int) -> Array | None:
    """Return coefficients (1, x, y[, xx, xy, yy]; 2) of a polynomial through points, None where they do not fix it."""
    terms = [np.ones(len(x)), x[:, 0], x[:, 1]]
    if order == 2:
        terms += [x[:, 0] ** 2, x[:, 0] * x[:, 1], x[:, 1] ** 2]
    A = np.stack(terms, -1)
    if len(x) < A.shape[1] + (order == 2) or np.linalg.matrix_rank(A) < A.shape[1]:
        return None
    return np.asarray(np.linalg.lstsq(A, y, rcond=None)[0])


def fit_homography(source: Array, target: Array) -> Array | None:
    """Return H (3, 3) that maps points (n, 2) to points (n, 2) in the least-squares sense, or None."""
    if len(source) < 4:
        return None
    H, _ = cv2.findHomography(source.reshape(-1, 1, 2), target.reshape(-1, 1, 2), 0)
    return None if H is None or not np.isfinite(H).all() else np.asarray(H, float)


def apply_homography(H: Array, points: Array) -> Array:
    """Return the points (n, 2) that H maps points (n, 2) to."""
    x = np.column_stack([points, np.ones(len(points))]) @ H.T
    return np.asarray(x[:, :2] / x[:, 2:])


def homography_jacobian(H: Array, points: Array) -> Array:
    """Return the derivative (n, 2, 2) of `apply_homography` at points (n, 2)."""
    x = np.column_stack([points, np.ones(len(points))]) @ H.T
    mapped = x[:, :2] / x[:, 2:]
    return np.asarray((H[None, :2, :2] - mapped[:, :, None] * H[None, 2:, :2]) / x[:, 2, None, None])
