"""NumPy twins of look-ups in another measurement: of a texture image's pixels, of points."""

from __future__ import annotations

import numpy as np

from planish.geometry import transform_points


def align_texture(image, own, b, contrast, T_b_a, gate):
    """Pixels (h, w, 2) of b at those of a texture image of a, b's texture and its sigma (h, w), which have any."""
    v, u = np.nonzero(own)
    points, normals, _ = (m.astype(float) for m in image.surface.at(image.source_px[v, u]))
    points, normals = transform_points(T_b_a, points), normals @ T_b_a[:3, :3].T
    pixels = b.camera.project(points)
    rows, columns = b.shape
    with np.errstate(invalid="ignore"):
        seen = ((pixels > -0.5) & (pixels < np.array([columns, rows]) - 0.5)).all(1)
        seen &= ((points - b.camera.center_sensor) * normals).sum(1) < 0
        at = np.where(seen[:, None], pixels, 0)
        column, row = np.rint(at).astype(int).T
        seen &= np.abs(((b.points_sensor[row, column] - points) * normals).sum(1)) <= gate
    value, sigma = between(np.nan_to_num(contrast[0]), at), between(contrast[1], at)
    seen &= np.isfinite(sigma)
    maps = [np.full((*own.shape, 2), np.nan, np.float32), np.zeros(own.shape), np.zeros(own.shape)]
    for out, found in zip(maps, (pixels, value, sigma), strict=True):
        out[v[seen], u[seen]] = found[seen]
    common = np.zeros(own.shape, bool)
    common[v[seen], u[seen]] = True
    return *maps, common


def between(picture, at):
    """Values of a picture (H, W) at places (N, 2), linearly interpolated; beyond the rim that of the nearest pixel."""
    first = np.floor(at).astype(int)
    x, y = (at - first).T
    last = np.array(picture.shape)[::-1] - 1
    (u, v), (right, below) = (np.clip(first + k, 0, last).T for k in (0, 1))
    above = (1 - x) * picture[v, u] + x * picture[v, right]
    return (1 - y) * above + y * ((1 - x) * picture[below, u] + x * picture[below, right])


def nearest_pixels(points_b, stride, camera_a, shape_a, T_a_b):
    """Flat pixels of b and a (n,), and points of b in a (n, 3), of every n-th pixel of b that a's camera sees."""
    v, u = (x.ravel() for x in np.meshgrid(*(np.arange(0, n, stride) for n in points_b.shape[:2]), indexing="ij"))
    points = transform_points(T_a_b, points_b[v, u].astype(float))
    with np.errstate(invalid="ignore"):
        pixels = np.rint(camera_a.project(points))
        inside = ((pixels >= 0) & (pixels < shape_a[::-1])).all(1)
    column, row = pixels[inside].astype(int).T
    return (v * points_b.shape[1] + u)[inside], row * shape_a[1] + column, points[inside]
