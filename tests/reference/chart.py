"""NumPy twin of the chart rasteriser: every pixel asks every triangle."""

from __future__ import annotations

import numpy as np


def rasterise(points, normals, T_chart_sensor, pitch, min_cosine, max_edge, height, width):
    """Source pixel (h, w, 2) and height (h, w) [mm] of the surface above each chart pixel."""
    source, z = np.full((height, width, 2), np.nan), np.full((height, width), np.nan)
    chart = points.astype(float) @ T_chart_sensor[:3, :3].T + T_chart_sensor[:3, 3]
    faces = normals @ -T_chart_sensor[2, :3] >= min_cosine
    for v in range(points.shape[0] - 1):
        for u in range(points.shape[1] - 1):
            a, b, c, d = (v, u), (v, u + 1), (v + 1, u), (v + 1, u + 1)
            for corners in ((a, b, c), (d, c, b)):
                xyz = np.array([chart[i] for i in corners])
                if not all(faces[i] for i in corners) or np.isnan(xyz).any():
                    continue
                edges = np.abs(xyz[:, None, :2] - xyz[None, :, :2]).max()
                if edges <= max_edge:
                    _fill(xyz, np.array(corners), pitch, source, z)
    return source, z


def _fill(xyz, corners, pitch, source, z):
    A = np.vstack([xyz[:, :2].T / pitch, np.ones(3)])
    if abs(np.linalg.det(A)) < 1e-9:
        return
    for row in range(z.shape[0]):
        for column in range(z.shape[1]):
            w = np.linalg.solve(A, [column, row, 1])
            if (w < 0).any():
                continue
            depth = w @ xyz[:, 2]
            if not depth >= z[row, column]:
                z[row, column] = depth
                source[row, column] = (w @ corners)[::-1]
