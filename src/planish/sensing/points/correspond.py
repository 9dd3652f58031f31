"""Sub-pixel correspondence between two cameras: equal projector position on the exact epipolar curve."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from planish import _core
from planish.errors import InputError
from planish.geometry import Array, invert, skew
from planish.measurement import Map
from planish.rig import Camera
from planish.sensing.decode import PhaseMap

#: Baselines shorter than this give no depth [mm].
MIN_BASELINE_MM = 1e-3


@dataclass(frozen=True)
class Correspondences:
    """Where the other camera sees what a pixel of the organising camera sees.

    Parameters
    ----------
    pixel_px : ndarray (H, W, 2) float32
        Pixel (u, v) of the other camera [px]; NaN where none.
    sigma_px : ndarray (H, W) float32
        Standard deviation along the epipolar curve [px].
    """

    pixel_px: Map = field(metadata={"unit": "px"})
    sigma_px: Map = field(metadata={"unit": "px"})


def fundamental_matrix(own: Camera, other: Camera) -> Array:
    """Return F (3, 3): (u, v, 1) of `own` to its epipolar line (a, b, c), a u + b v + c = 0, in `other`, undistorted.

    Notes
    -----
    F = K_other^-T [t]x R K_own^-1 with x_other = R x_own + t (Hartley & Zisserman 2004, eq. 9.2).
    """
    T_other_own = other.T_camera_sensor @ invert(own.T_camera_sensor)
    R, t = T_other_own[:3, :3], T_other_own[:3, 3]
    if np.linalg.norm(t) < MIN_BASELINE_MM:
        raise InputError("rig", "both cameras stand at the same place", "two cameras with a baseline")
    return np.linalg.inv(other.K).T @ skew(t / np.linalg.norm(t)) @ R @ np.linalg.inv(own.K)


def _require_epipole_outside(own: Camera, other: Camera) -> None:
    # Around an epipole the epipolar lines run in all directions, and points there have no depth.
    width, height = other.size_px
    u, v = np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9)
    border = [np.column_stack(np.broadcast_arrays(*side)) for side in ((u, 0), (u, height - 1), (0, v), (width - 1, v))]
    rays = other.rays_sensor(np.concatenate(border)) @ other.T_camera_sensor[:3, :3].T
    x, y, z = other.T_camera_sensor[:3, :3] @ own.center_sensor + other.T_camera_sensor[:3, 3]
    # Compared without lens distortion, which is not defined far outside the image; in front or behind is the same.
    low, high = np.nanmin(rays[:, :2], 0) * abs(z), np.nanmax(rays[:, :2], 0) * abs(z)
    epipole = np.array([x, y]) * np.sign(z)
    if z != 0 and (epipole > low).all() and (epipole < high).all():
        place = other.K @ [x / z, y / z, 1.0]
        raise InputError(
            "rig",
            f"one camera stands in the other one's field of view (epipole at pixel {place[0]:.0f}, {place[1]:.0f})",
            "cameras beside each other, the epipoles outside the images",
        )


def undistortion_shifts(camera: Camera, threads: int) -> Map:
    """Return each pixel's shift (H, W, 2) [px] to its place without lens distortion; size 0 without distortion."""
    if not camera.distortion.any():
        return np.empty((0, 0, 2), np.float32)
    return _cached_shifts(camera.kernel_parameters.tobytes(), camera.size_px, threads)


@lru_cache(maxsize=4)
def _cached_shifts(parameters: bytes, size_px: tuple[int, int], threads: int) -> Map:
    # Captures of one sensor share the calibration: four tables of 11 MB at 1.4 million pixels are kept.
    shifts = _core.undistortion_shifts(np.frombuffer(parameters), size_px[1], size_px[0], threads)
    shifts.flags.writeable = False
    return shifts


def correspond(
    own: PhaseMap, other: PhaseMap, own_camera: Camera, other_camera: Camera, threads: int
) -> Correspondences:
    """Return the correspondence of every pixel of `own` in `other`.

    The search runs along the image axis that is nearer to the epipolar lines, between successive pixels whose
    positions enclose the one looked for; no phase of `own` is interpolated, and nothing is filtered.

    Raises
    ------
    InputError
        Where the cameras stand at the same place or the epipole lies inside the other image.

    Parameters
    ----------
    own, other : PhaseMap
        The organising camera (H, W) and the other one; pixels beside jumps already rejected, or the interpolation
        would bridge them.
    own_camera, other_camera : Camera
        Their calibration, with lens distortion.
    threads : int
        Number of threads; the result does not depend on it.

    Notes
    -----
    sigma = sqrt(sigma_own^2 + w sigma_other^2) / |d position / d pixel|, w the sum of the squared interpolation weights
    (docs/measure.md).
    """
    F = fundamental_matrix(own_camera, other_camera)
    _require_epipole_outside(own_camera, other_camera)
    width, height = own_camera.size_px
    line = F @ [0.5 * width, 0.5 * height, 1.0]
    steep = bool(abs(line[0]) > abs(line[1]))
    position, sigma = other.position_px, other.sigma_px
    if other.local_mean_gain != 1:
        # The other camera is read as a local mean.
        sigma = sigma * np.float32(other.local_mean_gain)
    if steep:
        position, sigma = np.ascontiguousarray(position.T), np.ascontiguousarray(sigma.T)
        F = F[[1, 0, 2]]
    pixel, pixel_sigma = _core.correspond(
        own.position_px,
        own.sigma_px,
        undistortion_shifts(own_camera, threads),
        position,
        sigma,
        other_camera.kernel_parameters,
        steep,
        np.ascontiguousarray(F),
        threads,
    )
    return Correspondences(np.ascontiguousarray(pixel[..., ::-1]) if steep else pixel, pixel_sigma)
