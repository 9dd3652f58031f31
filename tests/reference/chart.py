"""NumPy twins of the chart kernels: every pixel asks its nodes, every pixel of the raster asks every triangle."""

from __future__ import annotations

import numpy as np


def _blended(nodes, step, u, v):
    """Weighted mean (13,) of the four nodes around a pixel."""
    total = np.zeros(nodes.shape[2])
    ends = []
    for at, count in ((v, nodes.shape[0]), (u, nodes.shape[1])):
        x = (at - step // 2) / step
        first = int(np.clip(np.floor(x), 0, count - 1))
        weight = np.clip(x - first, 0, 1)
        ends.append(((first, 1 - weight), (min(first + 1, count - 1), weight)))
    for row, wy in ends[0]:
        for column, wx in ends[1]:
            total += (wx * wy + 1e-3) * nodes[row, column].astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / total[0]


def coordinates(points, nodes, step, max_height):
    """Place (H, W, 2) [mm] of each pixel on the unrolled surface."""
    out = np.full((*points.shape[:2], 2), np.nan)
    for v, u in np.ndindex(points.shape[:2]):
        node = _blended(nodes, step, u, v)
        at = node[1:10].reshape(3, 3) @ points[v, u].astype(float) + node[10:]
        if abs(at[2]) <= max_height:
            out[v, u] = at[:2]
    return out


def rasterise(places, origin, pitch, max_edge, height, width):
    """Source pixel (h, w, 2) of each pixel of the raster."""
    source = np.full((height, width, 2), np.nan)
    for v in range(places.shape[0] - 1):
        for u in range(places.shape[1] - 1):
            a, b, c, d = (v, u), (v, u + 1), (v + 1, u), (v + 1, u + 1)
            for corners in ((a, b, c), (d, c, b)):
                xy = np.array([places[i] for i in corners])
                if np.isnan(xy).any() or np.abs(xy[:, None] - xy[None]).max() > max_edge:
                    continue
                _fill((xy - origin) / pitch, np.array(corners), source)
    return source


def _fill(xy, corners, source):
    A = np.vstack([xy.T, np.ones(3)])
    if abs(np.linalg.det(A)) < 1e-9:
        return
    for row, column in np.ndindex(source.shape[:2]):
        w = np.linalg.solve(A, [column, row, 1])
        if (w >= 0).all() and np.isnan(source[row, column, 0]):
            source[row, column] = (w @ corners)[::-1]


def surface(source, points, normals, nodes, step):
    """Point, unit normal and unit tangent along x (h, w, 3 each) at each pixel of the raster."""
    out = np.full((3, *source.shape[:2], 3), np.nan)
    for row, column in np.ndindex(source.shape[:2]):
        u, v = source[row, column].astype(float)
        if np.isnan(u):
            continue
        x, y = min(int(u), points.shape[1] - 2), min(int(v), points.shape[0] - 2)
        w = np.outer([1 - (v - y), v - y], [1 - (u - x), u - x])
        point, normal = (np.tensordot(w, m[y : y + 2, x : x + 2].astype(float)) for m in (points, normals))
        normal /= np.linalg.norm(normal)
        axis = _blended(nodes, step, u, v)[1:4]
        axis -= axis @ normal * normal
        out[:, row, column] = point, normal, axis / np.linalg.norm(axis)
    return out
