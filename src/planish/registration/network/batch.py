"""The motions of `planish.geometry` for many transforms at once: each step treats thousands of pairs."""

from __future__ import annotations

import numpy as np

from planish.geometry import SMALL_ANGLE, Array


def skews(v: Array) -> Array:
    """Return the matrices (n, 3, 3) with skew(v) w = v x w of vectors (n, 3)."""
    S = np.zeros((len(v), 3, 3))
    S[:, 0, 1], S[:, 0, 2], S[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return S - np.swapaxes(S, 1, 2)


def inverses(T: Array) -> Array:
    """Return the inverses (n, 4, 4) of rigid transforms (n, 4, 4)."""
    out = np.zeros_like(T)
    out[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    out[:, :3, 3] = -(out[:, :3, :3] @ T[:, :3, 3:])[:, :, 0]
    out[:, 3, 3] = 1
    return out


def adjoints(T: Array) -> Array:
    """Return the adjoints (n, 6, 6) of transforms (n, 4, 4)."""
    A = np.zeros((len(T), 6, 6))
    A[:, :3, :3] = A[:, 3:, 3:] = T[:, :3, :3]
    A[:, 3:, :3] = skews(T[:, :3, 3]) @ T[:, :3, :3]
    return A


def moved_points(T: Array, points: Array) -> Array:
    """Return T x (n, 3) of one point (n, 3) per transform (n, 4, 4)."""
    return (T[:, :3, :3] @ points[:, :, None])[:, :, 0] + T[:, :3, 3]


def shifts(points: Array) -> Array:
    """Return the transforms (n, 4, 4) that add points (n, 3)."""
    T = np.tile(np.eye(4), (len(points), 1, 1))
    T[:, :3, 3] = points
    return T


def exponentials(xi: Array) -> Array:
    """Return the transforms (n, 4, 4) of tangent vectors (n, 6) [rad, mm] (Sola et al. 2018, eq. 172)."""
    K, angle = skews(xi[:, :3]), np.linalg.norm(xi[:, :3], axis=1)
    a, b, c = _series(angle)
    K2, unit = K @ K, np.eye(3)
    T = np.zeros((len(xi), 4, 4))
    T[:, :3, :3] = unit + a * K + b * K2
    T[:, :3, 3] = ((unit + b * K + c * K2) @ xi[:, 3:, None])[:, :, 0]
    T[:, 3, 3] = 1
    return T


def logarithms(T: Array) -> Array:
    """Return the tangent vectors (n, 6) [rad, mm] of transforms (n, 4, 4) that turn by less than pi - 0.1."""
    R = T[:, :3, :3]
    vee = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
    sine = np.linalg.norm(vee, axis=1)
    angle = np.arctan2(sine, (np.trace(R, axis1=1, axis2=2) - 1) / 2)
    factor = np.where(angle < SMALL_ANGLE, 1.0, angle / np.maximum(sine, 1e-300))
    rotation = factor[:, None] * vee
    K = skews(rotation)
    _, b, c = _series(np.linalg.norm(rotation, axis=1))
    translation = np.linalg.solve(np.eye(3) + b * K + c * (K @ K), T[:, :3, 3:])[:, :, 0]
    return np.concatenate([rotation, translation], 1)


def _series(angle: Array) -> tuple[Array, Array, Array]:
    """Sin x / x, (1 - cos x) / x^2, (x - sin x) / x^3, each (n, 1, 1); by series where the closed forms lose digits."""
    small = angle < SMALL_ANGLE
    x = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(x) / x)
    b = np.where(small, 0.5, 2 * np.sin(x / 2) ** 2 / x**2)
    c = np.where(small, 1 / 6, (x - np.sin(x)) / x**3)
    return a[:, None, None], b[:, None, None], c[:, None, None]
