"""Where the middle of a disc's image lies: not where the disc's own middle is seen."""

from __future__ import annotations

import numpy as np

from planish.geometry import Array
from planish.rig import Camera

#: Step [normalised coordinates] of the differences that give the lens's curvature.
STEP = 1e-3


def disc_shift(camera: Camera, points_sensor: Array, T_sensor_board: Array, radius_mm: float) -> Array:
    """Return by how much [px] the centroid of each disc's image is off the image of the disc's middle (V, N, 2).

    Parameters
    ----------
    camera : Camera
        What sees the discs.
    points_sensor : ndarray (V, N, 3)
        Their middles [mm].
    T_sensor_board : ndarray (V, 4, 4)
        The discs lie in planes z = constant of the board.
    radius_mm : float
        Their radius.

    Notes
    -----
    The plane with the disc's middle as origin maps to directions by H = [r1 r2 m]. The disc is the dual conic
    diag(r^2, r^2, -1), its image H diag(r^2, r^2, -1) H', an ellipse, from which centre and second moments S are read
    (Hartley and Zisserman, Multiple View Geometry, 2003, result 8.6 on dual conics). The lens moves the ellipse's
    centroid from d(c) to d(c) + tr(H_d S) / 2 + J S grad ln |J|, to second order in the ellipse's size.
    """
    T = camera.T_camera_sensor
    V, N = points_sensor.shape[:2]
    H = np.empty((V, N, 3, 3))
    H[..., :2] = (T[:3, :3] @ T_sensor_board[:, :3, :2])[:, None]
    H[..., 2] = points_sensor @ T[:3, :3].T + T[:3, 3]
    conic = (H * [radius_mm**2, radius_mm**2, -1.0]) @ H.swapaxes(-1, -2)
    conic = (conic / conic[..., 2:, 2:]).reshape(-1, 3, 3)
    center = conic[:, :2, 2]
    moments = (center[:, :, None] * center[:, None] - conic[:, :2, :2]) / 4
    middle = H[..., :2, 2].reshape(-1, 2) / H[..., 2:, 2].reshape(-1, 1)
    shift = camera.distort(center) - camera.distort(middle) + _by_curvature(camera, center, moments)
    return (shift @ camera.K[:2, :2].T).reshape(V, N, 2)


def _by_curvature(camera: Camera, center: Array, moments: Array) -> Array:
    """Shift (n, 2) of the centroid of a region with these second moments (n, 2, 2) by the lens's curvature."""
    J = _jacobian(camera, center)
    curvature = np.zeros((len(center), 2, 2, 2))  # d J[i, j] / d n[k]
    growth = np.zeros((len(center), 2))
    for k in range(2):
        ahead, back = (_jacobian(camera, center + sign * STEP * np.eye(2)[k]) for sign in (1, -1))
        curvature[..., k] = (ahead - back) / (2 * STEP)
        growth[:, k] = (np.log(np.abs(np.linalg.det(ahead))) - np.log(np.abs(np.linalg.det(back)))) / (2 * STEP)
    bent = 0.5 * np.einsum("nijk,njk->ni", curvature, moments)
    return bent + np.einsum("nij,njk,nk->ni", J, moments, growth)


def _jacobian(camera: Camera, n: Array) -> Array:
    return camera.distortion_jacobian(n).T.reshape(-1, 2, 2)
