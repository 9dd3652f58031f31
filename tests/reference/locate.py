"""NumPy twin of the look-up of a texture image's pixels in another measurement."""

from __future__ import annotations

import numpy as np

from planish.geometry import transform_points


def locate_texture(image, own, b, T_b_a, gate):
    """Pixels (h, w, 2) of measurement b at which the pixels of a texture image of a lie; NaN where there is none."""
    v, u = np.nonzero(own)
    points, normals, _ = (m.astype(float) for m in image.surface.at(image.source_px[v, u]))
    points, normals = transform_points(T_b_a, points), normals @ T_b_a[:3, :3].T
    pixels = b.camera.project(points)
    rows, columns = b.shape
    with np.errstate(invalid="ignore"):
        seen = ((pixels > -0.5) & (pixels < np.array([columns, rows]) - 0.5)).all(1)
        seen &= ((points - b.camera.center_sensor) * normals).sum(1) < 0
        column, row = np.rint(np.where(seen[:, None], pixels, 0)).astype(int).T
        seen &= np.abs(((b.points_sensor[row, column] - points) * normals).sum(1)) <= gate
    out = np.full((*own.shape, 2), np.nan, np.float32)
    out[v[seen], u[seen]] = pixels[seen]
    return out
