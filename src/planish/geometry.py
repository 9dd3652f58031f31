"""Rigid transforms, their tangent space, plane frames.

`T_a_b` maps points of frame b into frame a, x_a = T_a_b x_b: 4 x 4, float64, millimetres. A tangent vector is
xi = [rotation rad, translation mm]; Exp is the exponential of SE(3) (Sola et al., A micro Lie theory, 2018, eq. 172).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planish.errors import InputError

Array = NDArray[np.float64]

#: Largest deviation of R R' from the unit matrix that still counts as a rotation (files carry 6 or more digits).
ROTATION_TOLERANCE = 1e-5
#: Angles below this are treated by series [rad]: the closed forms lose digits there.
SMALL_ANGLE = 1e-5


def skew(v: ArrayLike) -> Array:
    """Return the matrix (3, 3) with skew(v) w = v x w."""
    x, y, z = np.asarray(v, float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(rotation: ArrayLike) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) [rad] (Rodrigues)."""
    r = np.asarray(rotation, float)
    angle = float(np.linalg.norm(r))
    k = skew(r)
    if angle < SMALL_ANGLE:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + np.sin(angle) / angle * k + _versine(angle) / angle**2 * k @ k


def log_so3(R: ArrayLike) -> Array:
    """Return the rotation vector (3,) [rad] of a rotation matrix (3, 3), of length at most pi."""
    R = np.asarray(R, float)
    vee = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.linalg.norm(vee)), float((np.trace(R) - 1) / 2)
    angle = np.arctan2(sine, cosine)
    if angle < SMALL_ANGLE:
        return vee
    if cosine > -0.99:
        return angle / sine * vee
    # Near pi the axis is the eigenvector of R + R' with the largest eigenvalue; its sign follows the skew part.
    axis = np.linalg.eigh(R + R.T)[1][:, -1]
    return angle * axis * (1.0 if axis @ vee >= 0 else -1.0)


def _left_jacobian(r: Array) -> Array:
    angle = float(np.linalg.norm(r))
    k = skew(r)
    if angle < SMALL_ANGLE:
        return np.eye(3) + 0.5 * k + k @ k / 6
    return np.eye(3) + _versine(angle) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * k @ k


def _versine(angle: float) -> float:
    # 1 - cos, without its loss of digits at small angles.
    return float(2 * np.sin(angle / 2) ** 2)


def exp_se3(xi: ArrayLike) -> Array:
    """Return the transform (4, 4) of a tangent vector (6,) [rad, mm]."""
    xi = np.asarray(xi, float)
    T = np.eye(4)
    T[:3, :3] = exp_so3(xi[:3])
    T[:3, 3] = _left_jacobian(xi[:3]) @ xi[3:]
    return T


def log_se3(T: ArrayLike) -> Array:
    """Return the tangent vector (6,) [rad, mm] of a transform (4, 4)."""
    T = np.asarray(T, float)
    rotation = log_so3(T[:3, :3])
    return np.concatenate([rotation, np.linalg.solve(_left_jacobian(rotation), T[:3, 3])])


def compose(R: ArrayLike, t: ArrayLike) -> Array:
    """Return the transform (4, 4) of a rotation (3, 3) and a translation (3,) [mm]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.ravel(t)
    return T


def invert(T: ArrayLike) -> Array:
    """Return the inverse (4, 4) of a rigid transform (4, 4)."""
    T = np.asarray(T, float)
    return compose(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def translation(p: ArrayLike) -> Array:
    """Return the transform (4, 4) that adds p (3,) [mm]."""
    return compose(np.eye(3), p)


def perturb(T_a_b: ArrayLike, xi: ArrayLike, point_a: ArrayLike) -> Array:
    """Return Trans(p) Exp(xi) Trans(-p) T_a_b (4, 4): xi (6,) [rad, mm] acts in frame a about the point p (3,) [mm]."""
    p = np.asarray(point_a, float)
    return translation(p) @ exp_se3(xi) @ translation(-p) @ np.asarray(T_a_b, float)


def difference(T_a_b: ArrayLike, T_hat: ArrayLike, point_a: ArrayLike) -> Array:
    """Return xi (6,) [rad, mm] with perturb(T_hat, xi, point_a) = T_a_b."""
    p = np.asarray(point_a, float)
    return log_se3(translation(-p) @ np.asarray(T_a_b, float) @ invert(T_hat) @ translation(p))


def adjoint(T: ArrayLike) -> Array:
    """Return the adjoint (6, 6) with T Exp(xi) T^-1 = Exp(adjoint(T) xi), for xi = [rotation, translation]."""
    T = np.asarray(T, float)
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = T[:3, :3]
    A[3:, :3] = skew(T[:3, 3]) @ T[:3, :3]
    return A


def transform_points(T_a_b: ArrayLike, points_b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return points (..., 3) of frame b in frame a [mm]; NaN stays NaN, float32 stays float32 (computed in float64)."""
    T = np.asarray(T_a_b, float)
    out = np.asarray(points_b, float) @ T[:3, :3].T + T[:3, 3]
    return out.astype(points_b.dtype, copy=False)


def rotation_angle(R: ArrayLike) -> float:
    """Return the angle [rad] of a rotation (3, 3) or transform (4, 4)."""
    return float(np.linalg.norm(log_so3(np.asarray(R, float)[:3, :3])))


def is_rigid(T: ArrayLike) -> bool:
    """Return whether T is a finite 4 x 4 rigid transform (rotation within ROTATION_TOLERANCE, no mirror image)."""
    T = np.asarray(T, float)
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.array_equal(T[3], [0, 0, 0, 1]):
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < ROTATION_TOLERANCE and np.linalg.det(R) > 0)


def require_array(values: ArrayLike, shape: tuple[int, ...], name: str, expected: str) -> Array:
    """Return finite numbers as a float64 array of `shape`, or raise an error that names the argument or key `name`."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):  # rows of different length, text
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        found = values.tolist() if isinstance(values, np.ndarray) else values
        raise InputError(name, f"found {found}", expected)
    return array


def require_rigid(T: ArrayLike, name: str) -> Array:
    """Return T as a float64 array (4, 4) or raise an error that names the argument or file key `name`."""
    expected = "a 4 x 4 rigid transform (rotation, translation in mm)"
    matrix = require_array(T, (4, 4), name, expected)
    if not is_rigid(matrix):
        raise InputError(name, f"found {matrix.tolist()}", expected)
    return matrix


def nearest_rotation(M: ArrayLike) -> Array:
    """Return the rotation (3, 3) nearest to M in the Frobenius norm (Kabsch 1976, by SVD)."""
    U, _, Vt = np.linalg.svd(np.asarray(M, float))
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def fit_rigid(points_a: ArrayLike, points_b: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Return T_a_b (4, 4) that minimises the weighted sum of |a - T_a_b b|^2 over points (N, 3), N >= 3 (Kabsch)."""
    a, b = np.asarray(points_a, float), np.asarray(points_b, float)
    w = np.ones(len(a)) if weights is None else np.asarray(weights, float)
    mean_a, mean_b = w @ a / w.sum(), w @ b / w.sum()
    R = nearest_rotation(((a - mean_a) * w[:, None]).T @ (b - mean_b))
    return compose(R, mean_a - R @ mean_b)


def plane_frame(origin: ArrayLike, z_axis: ArrayLike, x_hint: ArrayLike) -> Array:
    """Return T_frame_world (4, 4): origin (3,), z along `z_axis` (3,), x as near to `x_hint` (3,) as possible."""
    z = np.asarray(z_axis, float) / np.linalg.norm(z_axis)
    x = np.asarray(x_hint, float) - (np.asarray(x_hint, float) @ z) * z
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return compose(R, -R @ np.asarray(origin, float))


def move_covariance(covariance: ArrayLike, point_from: ArrayLike, point_to: ArrayLike) -> Array:
    """Return the covariance (6, 6) of xi about another point of the same frame (points (3,) [mm])."""
    A = adjoint(translation(np.asarray(point_from, float) - np.asarray(point_to, float)))
    return A @ np.asarray(covariance, float) @ A.T
