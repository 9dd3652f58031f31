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
    width, height = own_camera.size_px
    line = F @ [0.5 * width, 0.5 * height, 1.0]
    steep = abs(line[0]) > abs(line[1])
    # The other camera is read as a local mean.
    position, sigma = other.position_px, other.sigma_px * np.float32(other.local_mean_gain)
    shifts = undistortion_shifts(other_camera, threads)
    if steep:
        position, sigma = np.ascontiguousarray(position.T), np.ascontiguousarray(sigma.T)
        shifts = np.ascontiguousarray(shifts.transpose(1, 0, 2)[..., ::-1])
        F = F[[1, 0, 2]]
    own_shifts = undistortion_shifts(own_camera, threads)
    pixel, pixel_sigma = _core.correspond(
        own.position_px, own.sigma_px, own_shifts, position, sigma, shifts, np.ascontiguousarray(F), threads
    )
    return Correspondences(np.ascontiguousarray(pixel[..., ::-1]) if steep else pixel, pixel_sigma)
