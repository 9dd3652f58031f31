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


def _between(values, u, v, x):
    """Distances (N,) of points x (N, 3) from the surface between four pixels, along its normal; normals (N, 3).

    Half way between the chord of the four points and their planes.
    """
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    normal = bilinear(values[..., 4:7], u, v)
    chord = (normal * (x - bilinear(values[..., 0:3], u, v))).sum(1)
    planes = np.zeros(len(u))
    for j in range(2):
        for i in range(2):
            corner = values[row + j, column + i].astype(float)
            weight = np.abs(1 - i - (u - column)) * np.abs(1 - j - (v - row))
            planes += weight * (corner[:, 4:7] * (x - corner[:, 0:3])).sum(1)
    return (chord + planes) / 2, normal


def residuals(maps_a, camera_a, maps_b, T_a_b, about, max_distance, min_cosine, gain=0.0, offset=0.0):
    """Residuals of b against a: rows, columns of b, distance with three Jacobians, difference with three Jacobians.

    Residuals and Jacobians are in units of the residuals' noise; a Jacobian is that of the mean, of a's and of b's
    normal or gradient. The difference is NaN where a texture is unknown; a's is taken to have more contrast by `gain`,
    of which each side is corrected by half, and to lie higher by `offset`.
    """
    (values_a, texture_a, use_a), (values_b, texture_b, use_b) = maps_a, maps_b
    R = T_a_b[:3, :3]
    rows, columns = np.nonzero(np.isfinite(values_b[..., 2]) & (use_b != 0))
    x = values_b[rows, columns, :3].astype(float) @ R.T + T_a_b[:3, 3]
    u, v = camera_a.project(x).T
    height, width = use_a.shape
    keep = (u >= 1) & (v >= 1) & (u < width - 2) & (v < height - 2)
    keep[keep] = use_a[np.floor(v[keep]).astype(int), np.floor(u[keep]).astype(int)] != 0
    rows, columns, x, u, v = rows[keep], columns[keep], x[keep], u[keep], v[keep]
    distance, n_a = _between(values_a, u, v, x)
    n_b = values_b[rows, columns, 4:7].astype(float) @ R.T
    with np.errstate(invalid="ignore"):
        near = (np.abs(distance) <= max_distance) & ((n_a * n_b).sum(1) >= min_cosine)
    rows, columns, x, u, v, n_a, n_b, distance = (i[near] for i in (rows, columns, x, u, v, n_a, n_b, distance))
    at_a, at_b = bilinear(values_a, u, v), values_b[rows, columns].astype(float)
    lever, mean = x - about, n_a + n_b
    sigma = np.sqrt(at_a[:, 3] + at_b[:, 3])[:, None]
    of_distance = [_jacobian(lever, n / sigma) for n in (mean / np.linalg.norm(mean, axis=1, keepdims=True), n_a, n_b)]
    noise = np.sqrt(at_a[:, 7] + at_b[:, 7])[:, None]
    share_a, share_b = 1 - gain / 2, 1 + gain / 2
    difference = (share_a * cubic(texture_a, u, v) - share_b * texture_b[rows, columns] - offset) / noise[:, 0]
    J_a, J_b = (
        _jacobian(lever, share * g / noise) for share, g in ((share_a, at_a[:, 8:11]), (share_b, at_b[:, 8:11] @ R.T))
    )
    difference[~(np.isfinite(J_a).all(1) & np.isfinite(J_b).all(1))] = np.nan
    return rows, columns, distance / sigma[:, 0], of_distance, difference, [(J_a + J_b) / 2, J_a, J_b]


def tile_pulls(maps_a, camera_a, maps_b, T_a_b, about, weights, max_distance, min_cosine, tile, step=1e-3):
    """Derivative (rows, columns, 6, 3) of each tile's gradient J' W r by a displacement of its points; NaN without any.

    `weights` (2, 2) are scale and weight of distances and of differences. Central differences [mm] of the definition,
    b shifted as a whole.
    """
    ends = []
    for axis in range(3):
        for sign in (1, -1):
            T = np.array(T_a_b)
            T[axis, 3] += sign * step
            found = residuals(maps_a, camera_a, maps_b, T, about, max_distance, min_cosine)
            rows, columns, d, (J, _, _), t, (J_t, _, _) = found
            w_d, w_t = (w * tukey(r, scale) for r, (scale, w) in zip((d, t), weights, strict=True))
            with np.errstate(invalid="ignore"):
                by_texture = np.where(np.isfinite(t)[:, None], (w_t * t)[:, None] * J_t, 0.0)
            gradient = (w_d * d)[:, None] * J + by_texture
            shape = tuple(-(-n // tile) for n in maps_b[1].shape)
            sums, counts = np.zeros((*shape, 6)), np.zeros(shape)
            np.add.at(sums, (rows // tile, columns // tile), gradient)
            np.add.at(counts, (rows // tile, columns // tile), 1)
            ends.append(np.where(counts[..., None] > 0, sums, np.nan))
    return np.stack([(ends[2 * k] - ends[2 * k + 1]) / (2 * step) for k in range(3)], -1)


def level_values(maps, centre, blur, blur_sigma, spacing):
    """Channels (h, w, 12) of every n-th pixel, those of the texture's gradient left NaN."""
    points, sigma, normals, _, by_blur, texture_sigma, texture, by_spline = (
        np.asarray(m[::spacing, ::spacing], float) for m in maps
    )
    points = points - by_spline[..., None] * normals
    ray = points - centre
    cosine = (ray * normals).sum(-1) / np.linalg.norm(ray, axis=-1)
    out = np.full((*sigma.shape, 12), np.nan)
    out[..., 0:3] = points - blur * by_blur[..., None] * normals
    out[..., 3] = (sigma * cosine) ** 2 + (blur_sigma * by_blur) ** 2
    out[..., 4:7] = normals
    out[..., 7] = np.where(np.isfinite(texture), texture_sigma**2 / spacing**2, np.nan)
    out[..., 11] = blur_sigma * by_blur
    return out


def slopes(texture, axis):
    """Differences of a texture (H, W) along an axis, of the sixth order where seven values in a row are known."""
    before = {k: np.roll(texture.astype(float), k, axis) for k in (1, 2, 3)}
    after = {k: np.roll(texture.astype(float), -k, axis) for k in (1, 2, 3)}
    near, middle, far = (after[k] - before[k] for k in (1, 2, 3))
    wide = 0.75 * near - 0.15 * middle + far / 60
    out = np.where(np.isfinite(wide), wide, near / 2)
    count = texture.shape[axis]
    at = np.arange(count).reshape(-1, 1) if axis == 0 else np.arange(count)
    inner, rim = (at >= 3) & (at < count - 3), (at == 0) | (at == count - 1)
    out = np.where(inner, out, near / 2)
    out = np.where(rim, np.nan, out)
    # Nor is there a slope on the border along the other axis.
    across = np.arange(texture.shape[1 - axis])
    across = across if axis == 0 else across.reshape(-1, 1)
    return np.where((across == 0) | (across == texture.shape[1 - axis] - 1), np.nan, out)
