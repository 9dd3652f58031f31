"""NumPy twins of the kernels of the overlap: one point, one cell, one tile at a time."""

from __future__ import annotations

import numpy as np

SNAP_PX = 1e-3


def weigh(coordinate, size):
    if not -SNAP_PX < coordinate < size - 1 + SNAP_PX:
        return None
    nearest = round(coordinate)
    return (nearest, 0.0) if abs(coordinate - nearest) < SNAP_PX else (int(np.floor(coordinate)), coordinate % 1)


def look_up_distance(points_a, normals_a, camera_a, points_b, normals_b, T_a_b, limit):
    out = np.full(points_b.shape[:2], np.nan, np.float32)
    x = points_b.astype(float) @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    m = normals_b.astype(float) @ T_a_b[:3, :3].T
    pixels = camera_a.project(x)
    for v, u in np.argwhere(np.isfinite(pixels[..., 0])):
        wu, wv = weigh(pixels[v, u, 0], points_a.shape[1]), weigh(pixels[v, u, 1], points_a.shape[0])
        if wu is None or wv is None:
            continue
        n = normals_a[wv[0] + (wv[1] > 0.5), wu[0] + (wu[1] > 0.5)].astype(float)
        if not np.isfinite(n).all() or n @ m[v, u] < 0:
            continue
        corners = [
            ((fv if j else 1 - fv) * (fu if i else 1 - fu), n @ (x[v, u] - points_a[iv + j, iu + i].astype(float)))
            for (iu, fu), (iv, fv) in [(wu, wv)]
            for j in range(1 + (fv > 0))
            for i in range(1 + (fu > 0))
        ]
        weights, distances = np.array(corners).T
        if np.isfinite(distances).all() and np.ptp(distances) <= limit and abs(weights @ distances) <= limit:
            out[v, u] = weights @ distances
    return out


def cell_medians(values, size, least):
    rows, columns = -(-values.shape[0] // size), -(-values.shape[1] // size)
    out = np.full((rows, columns), np.nan, np.float32)
    for i, j in np.ndindex(rows, columns):
        cell = values[i * size : (i + 1) * size, j * size : (j + 1) * size]
        cell = cell[np.isfinite(cell)]
        if len(cell) and len(cell) >= least:
            out[i, j] = np.median(cell)
    return out


def keys_weights(f):
    """Keys 1981, a = -1/2, written as the piecewise kernel of the distance."""
    s = np.abs(np.array([f + 1, f, 1 - f, 2 - f]))
    return np.where(s < 1, 1.5 * s**3 - 2.5 * s**2 + 1, -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2)


def sample(image, u, v):
    iu, iv = int(np.floor(u)), int(np.floor(v))
    if iu < 1 or iv < 1 or iu >= image.shape[1] - 2 or iv >= image.shape[0] - 2:
        return np.nan
    return keys_weights(v - iv) @ image[iv - 1 : iv + 3, iu - 1 : iu + 3].astype(float) @ keys_weights(u - iu)


def tile_residual(value_a, value_b, sigma_a, sigma_b, pixels_b, row, size, shift):
    """Normal equations' right-hand side of one tile at one shift: zero at the kernel's solution."""
    r, c = int(row[0]), int(row[1])
    J_a, J_b, offset = row[2:6].reshape(2, 2), row[6:10].reshape(2, 2), row[10:]
    G, d, w = [], [], []
    for v in range(max(1, r * size), min((r + 1) * size, value_a.shape[0] - 1)):
        for u in range(max(1, c * size), min((c + 1) * size, value_a.shape[1] - 1)):
            x, y = pixels_b[v, u].astype(float) + J_b @ shift + offset
            if not np.isfinite(x):
                continue
            b = sample(value_b, x, y)
            g = [value_a[v, u + 1] - value_a[v, u - 1], value_a[v + 1, u] - value_a[v - 1, u]]
            g = J_a.T @ (0.5 * np.array(g, float))
            iu, iv = int(np.floor(x)), int(np.floor(y))
            sb = sigma_b[iv + (y - iv > 0.5), iu + (x - iu > 0.5)] if np.isfinite(b) else np.nan
            if np.isfinite([b, sb, *g, value_a[v, u]]).all():
                G.append(g)
                d.append(value_a[v, u] - b)
                w.append(1 / (float(sigma_a[v, u]) ** 2 + float(sb) ** 2))
    G, d, w = np.array(G), np.array(d), np.array(w)
    G, d = G - w @ G / w.sum(), d - w @ d / w.sum()
    return (G * w[:, None]).T @ d, (G * w[:, None]).T @ G


def pixel_areas(tangents):
    areas = np.linalg.norm(np.cross(tangents[..., :3], tangents[..., 3:]), axis=-1)
    return np.nan_to_num(areas, nan=0.0)


def known_distances(distances, areas):
    known = np.isfinite(distances)
    return known.sum(), (distances[known].astype(float) ** 2).sum(), areas[known].sum(dtype=float)
