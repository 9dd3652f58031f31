"""NumPy twin of the joint residuals: all pixels of b at once, float64, written from the definitions."""

from __future__ import annotations

import numpy as np


def bilinear(image, u, v):
    """Values (N, ...) of an image at places u, v (N,) between four pixels."""
    x, y = np.floor(u).astype(int), np.floor(v).astype(int)
    f, g = u - x, v - y
    if image.ndim == 3:
        f, g = f[:, None], g[:, None]
    top = (1 - f) * image[y, x] + f * image[y, x + 1]
    bottom = (1 - f) * image[y + 1, x] + f * image[y + 1, x + 1]
    return (1 - g) * top + g * bottom


def _keys(x):
    """Keys' cubic convolution kernel, a = -1/2 (Keys 1981, eq. 15)."""
    x = np.abs(x)
    near = 1.5 * x**3 - 2.5 * x**2 + 1
    far = -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return np.where(x < 1, near, np.where(x < 2, far, 0.0))


def cubic(image, u, v):
    """Values (N,) of an image at places u, v (N,) between sixteen pixels."""
    x, y = np.floor(u).astype(int), np.floor(v).astype(int)
    total = np.zeros(len(u))
    for j in range(-1, 3):
        for i in range(-1, 3):
            total += _keys(u - x - i) * _keys(v - y - j) * image[y + j, x + i]
    return total


def tukey(r, scale):
    """Tukey's biweight with 95 % efficiency."""
    x = r / (4.685 * scale)
    return np.where(np.abs(x) < 1, (1 - x**2) ** 2, 0.0)


def _jacobian(lever, direction):
    return np.hstack([np.cross(lever, direction), direction])


def residuals(maps_a, camera_a, maps_b, T_a_b, about, max_distance, min_cosine):
    """Residuals of b against a: rows, columns of b, distance with Jacobian, difference with both Jacobians.

    The difference is NaN where a texture is unknown.
    """
    points_a, normals_a, texture_a, gradient_a, sigma_a, use_a = maps_a
    points_b, normals_b, texture_b, gradient_b, sigma_b, use_b = maps_b
    R = T_a_b[:3, :3]
    rows, columns = np.nonzero(np.isfinite(points_b[..., 2]) & (use_b != 0))
    x = points_b[rows, columns].astype(float) @ R.T + T_a_b[:3, 3]
    u, v = camera_a.project(x).T
    height, width = use_a.shape
    keep = (u >= 1) & (v >= 1) & (u < width - 2) & (v < height - 2)
    keep[keep] = use_a[np.floor(v[keep]).astype(int), np.floor(u[keep]).astype(int)] != 0
    rows, columns, x, u, v = rows[keep], columns[keep], x[keep], u[keep], v[keep]
    q, n_a = bilinear(points_a, u, v), bilinear(normals_a, u, v)
    known = np.isfinite(q[:, 2]) & np.isfinite(n_a[:, 2])
    rows, columns, x, u, v, q, n_a = (i[known] for i in (rows, columns, x, u, v, q, n_a))
    n_b = normals_b[rows, columns].astype(float) @ R.T
    distance = (n_a * (x - q)).sum(1)
    near = (np.abs(distance) <= max_distance) & ((n_a * n_b).sum(1) >= min_cosine)
    rows, columns, x, u, v, n_a, n_b, distance = (i[near] for i in (rows, columns, x, u, v, n_a, n_b, distance))
    lever, mean = x - about, n_a + n_b
    J = _jacobian(lever, mean / np.linalg.norm(mean, axis=1, keepdims=True))
    sigma = np.hypot(bilinear(sigma_a, u, v), sigma_b[rows, columns])[:, None]
    difference = (cubic(texture_a, u, v) - texture_b[rows, columns]) / sigma[:, 0]
    J_a = _jacobian(lever, bilinear(gradient_a, u, v) / sigma)
    J_b = _jacobian(lever, gradient_b[rows, columns].astype(float) @ R.T / sigma)
    difference[~(np.isfinite(J_a).all(1) & np.isfinite(J_b).all(1))] = np.nan
    return rows, columns, distance, J, difference, J_a, J_b


def tile_pulls(maps_a, camera_a, maps_b, T_a_b, about, weights, max_distance, min_cosine, tile, step=1e-3):
    """Derivative (rows, columns, 6, 3) of each tile's gradient J' W r by a displacement of its points; NaN without any.

    Central differences [mm] of the definition, b shifted as a whole.
    """
    ends = []
    for axis in range(3):
        for sign in (1, -1):
            T = np.array(T_a_b)
            T[axis, 3] += sign * step
            found = residuals(maps_a, camera_a, maps_b, T, about, max_distance, min_cosine)
            rows, columns, d, J, t, J_a, J_b = found
            w_d = weights.distance * tukey(d, weights.scale_distance_mm)
            w_t = weights.texture * tukey(t, weights.scale_texture)
            with np.errstate(invalid="ignore"):
                by_texture = np.where(np.isfinite(t)[:, None], (w_t * t)[:, None] * (J_a + J_b) / 2, 0.0)
            gradient = (w_d * d)[:, None] * J + by_texture
            shape = tuple(-(-n // tile) for n in maps_b[0].shape[:2])
            sums, counts = np.zeros((*shape, 6)), np.zeros(shape)
            np.add.at(sums, (rows // tile, columns // tile), gradient)
            np.add.at(counts, (rows // tile, columns // tile), 1)
            ends.append(np.where(counts[..., None] > 0, sums, np.nan))
    return np.stack([(ends[2 * k] - ends[2 * k + 1]) / (2 * step) for k in range(3)], -1)
