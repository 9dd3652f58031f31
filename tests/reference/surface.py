"""NumPy twins of the surface kernels, written from the definitions: one pixel at a time, float64 throughout."""

from __future__ import annotations

import numpy as np


def fit_pixel(points, camera, u, v, radius, max_slope):
    """Point and normal (3,) of the plane through the window around pixel (u, v), tangents (6,) [mm per pixel]."""
    R, t = camera.T_camera_sensor[:3, :3], camera.T_camera_sensor[:3, 3]
    height, width = points.shape[:2]
    rows, columns = np.mgrid[max(0, v - radius) : v + radius + 1, max(0, u - radius) : u + radius + 1]
    inside = (rows < height) & (columns < width)
    rows, columns = rows[inside], columns[inside]
    depth = points[rows, columns].astype(float) @ R[2] + t[2]
    own = float(points[v, u].astype(float) @ R[2] + t[2])
    # A change of depth of max_slope times the lateral reach of the window, as a change of inverse depth.
    limit = max_slope * (radius + 1) / own / min(camera.K[0, 0], camera.K[1, 1])
    near = np.abs(1 / depth - 1 / own) <= limit
    A = np.column_stack([np.ones(near.sum()), columns[near] - u, rows[near] - v])
    w, w_u, w_v = np.linalg.lstsq(A, 1 / depth[near], rcond=None)[0]
    ray, left, right, above, below = camera.rays_sensor(
        np.array([[u, v], [u - 1, v], [u + 1, v], [u, v - 1], [u, v + 1]], float)
    )
    # X = C + ray / w.
    x_u = (right - left) / 2 / w - ray * w_u / w**2
    x_v = (below - above) / 2 / w - ray * w_v / w**2
    normal = np.cross(x_u, x_v)
    normal *= -np.sign(normal @ ray) / np.linalg.norm(normal)
    return camera.center_sensor + ray / w, normal, np.concatenate([x_u, x_v])


def _slope(line, i):
    """Derivative at place i by the differences of sixth order, where seven values are known; else of second order."""
    if 3 <= i < len(line) - 3 and np.isfinite(line[[i - 3, i - 2, i + 2, i + 3]]).all():
        return sum(w * (line[i + k] - line[i - k]) for k, w in ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60)))
    return (line[i + 1] - line[i - 1]) / 2


def gradient_of_pixel(texture, tangents, u, v):
    """Tangential gradient (3,) of a texture at pixel (u, v): least-norm G with G . X_u = f_u, G . X_v = f_v."""
    f = [_slope(texture[v], u), _slope(texture[:, u], v)]
    return np.linalg.pinv(tangents[v, u].reshape(2, 3).astype(float)) @ np.array(f, float)
