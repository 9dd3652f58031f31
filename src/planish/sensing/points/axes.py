"""Which projector axis measures depth: the one whose position changes along the epipolar lines."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.rig import Camera
from planish.sensing.decode import PhaseMap
from planish.sensing.patterns.entries import Axis
from planish.sensing.points.correspond import MIN_BASELINE_MM

#: Share of an axis in the direction of the epipolar lines (cosine) below which it measures no depth: 3 degrees.
MIN_SHARE = 0.05
#: Every so many pixels serve to choose the axis; rows and columns of a grid of rays over the image.
SAMPLE_STRIDE, RAYS = 8, 5


def axis_between_cameras(phases: Mapping[Axis, PhaseMap], own: Camera, other: Camera, subject: str) -> Axis:
    """Return the axis whose positions in the other camera locate a point best along its epipolar lines.

    Parameters
    ----------
    phases : dict of PhaseMap
        The other camera's positions (H, W) per axis.
    own, other : Camera
        The organising camera and the other one.
    subject : str
        Named in errors.

    Raises
    ------
    InputError
        Where the stripes of every axis run along the epipolar lines: they tell nothing of depth.
    """
    # The epipole: the image of the own centre in the other camera (Hartley & Zisserman 2004, 9.2), homogeneous.
    epipole = other.K @ (other.T_camera_sensor[:3, :3] @ own.center_sensor + other.T_camera_sensor[:3, 3])
    quality, share = {}, {}
    for axis, phase in phases.items():
        u, v, along_u, along_v, sigma = _gradients(phase)
        line = np.stack([epipole[0] - epipole[2] * u, epipole[1] - epipole[2] * v])
        slope = np.abs(along_u * line[0] + along_v * line[1]) / np.hypot(*line)
        steepest = np.hypot(along_u, along_v)
        known = (steepest > 0) & (sigma > 0)
        share[axis] = float(np.median(slope[known] / steepest[known])) if known.any() else np.nan
        quality[axis] = float(np.median(slope[known] / sigma[known])) if known.any() else 0.0
    best = max(quality, key=lambda axis: quality[axis])
    # A camera that saw nothing has no say: what is missing is found, and named, per pixel.
    if share[best] < MIN_SHARE:
        raise _along_the_baseline(subject, tuple(share), "the two cameras")
    return best


def axis_to_projector(phases: Mapping[Axis, PhaseMap], own: Camera, projector: Camera, subject: str) -> Axis:
    """Return the axis whose positions locate a point best along the rays of the camera.

    Parameters
    ----------
    phases : dict of PhaseMap
        The camera's positions (H, W) per axis.
    own, projector : Camera
        The camera and the projector.
    subject : str
        Named in errors.

    Raises
    ------
    InputError
        Where the stripes of every axis run along the images of the camera's rays, or both stand at one place.
    """
    grid = [np.linspace(0, size - 1, RAYS) for size in own.size_px]
    center = projector.T_camera_sensor[:3, :3] @ own.center_sensor + projector.T_camera_sensor[:3, 3]
    if np.linalg.norm(center) < MIN_BASELINE_MM:
        raise InputError("rig", "camera and projector stand at the same place", "a baseline between them")
    rays = own.rays_sensor(np.stack(np.meshgrid(*grid), -1).reshape(-1, 2)) @ projector.T_camera_sensor[:3, :3].T
    # The image of a ray runs at right angles to the normal t x q of its plane, scaled by the projector's pixels.
    normal = np.cross(center, rays[np.isfinite(rays).all(1)])
    along = np.median(np.abs(normal[:, [1, 0]]), axis=0) * [projector.K[0, 0], projector.K[1, 1]]
    length = float(np.hypot(*along))
    shares: dict[Axis, float] = {"u": float(along[0]) / length, "v": float(along[1]) / length}
    quality = {}
    for axis, phase in phases.items():
        sigma = phase.sigma_px[::SAMPLE_STRIDE, ::SAMPLE_STRIDE]
        known = np.isfinite(sigma)
        quality[axis] = shares[axis] / float(np.median(sigma[known])) if known.any() else 0.0
    best = max(quality, key=lambda axis: quality[axis])
    if shares[best] < MIN_SHARE:
        raise _along_the_baseline(subject, tuple(phases), "camera and projector")
    return best


def axis_weights(phases: Mapping[Axis, PhaseMap]) -> tuple[float, float] | None:
    """Return by how much columns and rows of the projector count in its points: shares of the inverse variances.

    `phases` are the camera's positions (H, W) per axis; None where there are none.
    """
    information = {"u": 0.0, "v": 0.0}
    for axis, phase in phases.items():
        sigma = phase.sigma_px[::SAMPLE_STRIDE, ::SAMPLE_STRIDE]
        known = np.isfinite(sigma) & (sigma > 0)
        if known.any():
            information[axis] = 1 / float(np.median(sigma[known])) ** 2
    total = sum(information.values())
    return None if total == 0 else (information["u"] / total, information["v"] / total)


def _gradients(phase: PhaseMap) -> tuple[NDArray[np.floating], ...]:
    """Pixels (n,), change of position per pixel along u and v, and sigma, of a sample of the map."""
    p, s = phase.position_px, SAMPLE_STRIDE
    along_u = 0.5 * (p[1:-1:s, 2::s] - p[1:-1:s, :-2:s])
    along_v = 0.5 * (p[2::s, 1:-1:s] - p[:-2:s, 1:-1:s])
    v, u = np.nonzero(np.isfinite(along_u) & np.isfinite(along_v))
    sigma = phase.sigma_px[1:-1:s, 1:-1:s][v, u]
    return 1.0 + s * u, 1.0 + s * v, along_u[v, u], along_v[v, u], sigma


def _along_the_baseline(subject: str, axes: tuple[Axis, ...], between: str) -> InputError:
    return InputError(
        f"{subject}: sequence",
        f"the stripes along axis {' and '.join(axes)} run along the baseline between {between}: they measure no depth",
        f"a sequence that also encodes axis {'v' if axes[0] == 'u' else 'u'}",
    )
