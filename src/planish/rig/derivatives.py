"""How pixels and points change with the parameters of the calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.rig.camera import Camera
from planish.rig.parameters import DEVICE_PARAMETERS, DISTORTION, EXTERNAL_PART, INTRINSICS, selection
from planish.rig.rig import Rig


def project_with_derivatives(
    camera: Camera, points_sensor: NDArray[np.floating], parameters: Sequence[int] | None = None
) -> tuple[Array, Array, Array]:
    """Return pixels (N, 2) of points (N, 3) [mm], their derivatives by the point (N, 2, 3) and by the parameters.

    The latter are (N, 2, n), in the order of `parameters`: places in DEVICE_PARAMETERS, by default all 23. Points must
    lie in front of the camera.
    """
    R, t = camera.T_camera_sensor[:3, :3], camera.T_camera_sensor[:3, 3]
    y = np.asarray(points_sensor, float) @ R.T + t
    n = y[:, :2] / y[:, 2:]
    d = camera.distort(n)
    fx, fy, skew = camera.K[0, 0], camera.K[1, 1], camera.K[0, 1]
    pixels = np.stack([fx * d[:, 0] + skew * d[:, 1] + camera.K[0, 2], fy * d[:, 1] + camera.K[1, 2]], -1)
    by_point = _by_point(camera, y, n)
    wanted = range(len(DEVICE_PARAMETERS)) if parameters is None else parameters
    by_parameter = np.zeros((len(y), 2, len(wanted)))
    # y -> y + omega x y + tau.
    turning = np.cross(y[:, None], by_point) if any(place >= EXTERNAL_PART.start for place in wanted) else by_point
    coefficients = _DistortionTerms(camera, n)
    for column, place in enumerate(wanted):
        out = by_parameter[:, :, column]
        if place >= EXTERNAL_PART.start:
            axis = place - EXTERNAL_PART.start
            out[:] = turning[..., axis] if axis < 3 else by_point[..., axis - 3]
        elif place >= len(INTRINSICS):
            term = coefficients.by(place - len(INTRINSICS))
            out[:, 0] = fx * term[:, 0] + skew * term[:, 1]
            out[:, 1] = fy * term[:, 1]
        else:
            row, value = ((0, d[:, 0]), (1, d[:, 1]), (0, 1.0), (1, 1.0), (0, d[:, 1]))[place]
            out[:, row] = value
    return pixels, by_point @ R, by_parameter


def _by_point(camera: Camera, y: Array, n: Array) -> Array:
    """Derivative (N, 2, 3) of pixels by points in the camera's own frame."""
    D = camera.distortion_jacobian(n).T.reshape(-1, 2, 2)
    by_direction = camera.K[:2, :2] @ D
    perspective = np.zeros((len(y), 2, 3))
    perspective[:, 0, 0] = perspective[:, 1, 1] = 1.0
    perspective[:, :, 2] = -n
    return by_direction @ (perspective / y[:, 2, None, None])


class _DistortionTerms:
    """Derivatives (N, 2) of the distorted directions by single coefficients."""

    def __init__(self, camera: Camera, n: Array) -> None:
        k1, k2, _, _, k3, k4, k5, k6 = camera.distortion[:8]
        self.n, self.r2 = n, (n * n).sum(1)
        r2 = self.r2
        self.below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        self.radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / self.below

    def by(self, coefficient: int) -> Array:
        """Derivative (N, 2) by the coefficient of this place in OpenCV's order."""
        name, n, r2 = DISTORTION[coefficient], self.n, self.r2
        if name in ("k1", "k2", "k3"):
            return n * (r2 ** int(name[1]) / self.below)[:, None]
        if name in ("k4", "k5", "k6"):
            return -n * (self.radial * r2 ** (int(name[1]) - 3) / self.below)[:, None]
        if name in ("p1", "p2"):
            own = ("p2", "p1").index(name)
            term = np.stack([2 * n[:, 0] * n[:, 1]] * 2, -1)
            term[:, own] = r2 + 2 * n[:, own] ** 2
            return term
        term = np.zeros((len(n), 2))
        term[:, 0 if name in ("s1", "s2") else 1] = r2 if name in ("s1", "s3") else r2 * r2
        return term


def point_derivatives(
    rig: Rig,
    own: str,
    other: str,
    points_sensor: NDArray[np.floating],
    names: Sequence[str],
    direction_px: NDArray[np.floating] | None = None,
) -> Array:
    """Return the derivative (N, 3, n) of measured points by the named parameters, the images being what they are.

    Parameters
    ----------
    rig : Rig
        Calibration.
    own, other : str
        Devices that gave the points: the organising camera, and the other camera or "projector".
    points_sensor : ndarray (N, 3)
        Points [mm].
    names : sequence of str
        Parameters, as in `Rig.covariance_parameters`.
    direction_px : ndarray (2,) or (N, 2) or None
        Direction in the other device along which its position counts: (1, 0) for a projector that codes its columns
        alone. Default: along the epipolar line, as points of two cameras are triangulated.

    Notes
    -----
    A point stays on the ray of its own pixel, pi_own(x; a) = p, and on its place along `e` in the other device,
    e (pi_other(x; b) - q) = 0. Both differentiated give three linear equations for dx. Along the epipolar line,
    distances count in the undistorted image, where triangulation minimises them.
    """
    devices = rig.devices
    picks = selection(names, tuple(devices))
    _, own_by_point, own_by_parameter = project_with_derivatives(devices[own], points_sensor)
    _, other_by_point, other_by_parameter = project_with_derivatives(devices[other], points_sensor)
    if direction_px is None:
        direction_px = _epipolar_direction(devices[own], devices[other], points_sensor)
    e = np.broadcast_to(np.asarray(direction_px, float), (len(points_sensor), 2))
    equations = np.concatenate([own_by_point, np.einsum("ni,nij->nj", e, other_by_point)[:, None]], axis=1)
    change = np.concatenate(
        [
            own_by_parameter @ picks[own],
            (np.einsum("ni,nij->nj", e, other_by_parameter) @ picks[other])[:, None],
        ],
        axis=1,
    )
    return -np.linalg.solve(equations, change)


def _epipolar_direction(own: Camera, other: Camera, points_sensor: NDArray[np.floating]) -> Array:
    """Weights (N, 2) of a pixel difference in `other` that give its part along the undistorted epipolar line."""
    R, t = other.T_camera_sensor[:3, :3], other.T_camera_sensor[:3, 3]
    y = np.asarray(points_sensor, float) @ R.T + t
    ray = (np.asarray(points_sensor, float) - own.center_sensor) @ R.T
    n = y[:, :2] / y[:, 2:]
    along = ray[:, :2] - n * ray[:, 2:]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    by_direction = other.K[:2, :2] @ other.distortion_jacobian(n).T.reshape(-1, 2, 2)
    return np.asarray(np.linalg.solve(by_direction.transpose(0, 2, 1), along[:, :, None])[..., 0], np.float64)
