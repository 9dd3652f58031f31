"""How the points of a measurement move with the errors that its rig's covariance states; the images stay."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.rig import Camera, Rig
from planish.rig.derivatives import point_derivatives, project_with_derivatives
from planish.rig.parameters import PROJECTOR

#: Pixels to both sides over which maps are differentiated: far enough that their noise changes no direction, near
#: enough that lines of equal projector position are straight.
REACH_PX = 8
#: Slope of those lines against the epipolar lines' normal that is still believed: they cross at 11 degrees.
MAX_SLOPE = 5.0


def rig_key(rig: Rig) -> str:
    """Return a text that is the same for rigs of the same content, whatever their files: they share their errors."""
    numbers = [item for name in sorted(rig.devices) for item in (name, *_numbers(rig.devices[name]))]
    covariance = () if rig.covariance is None else (rig.covariance.tobytes(), *rig.covariance_parameters)
    return hashlib.sha256(repr((numbers, covariance)).encode()).hexdigest()


def _numbers(device: Camera) -> tuple[bytes, ...]:
    size = np.array(device.size_px, float)
    return tuple(item.tobytes() for item in (device.K, device.distortion, size, device.T_camera_sensor))


def states_errors(measurement: Measurement) -> bool:
    """Return whether the points' errors follow from the rig: it states a covariance, and it is known what gave them."""
    by_projector = measurement.rig.projector is not None and measurement.projector_weights is not None
    return measurement.rig.covariance is not None and (measurement.correspondence_px is not None or by_projector)


def displacements(
    measurement: Measurement, pixels: NDArray[np.integer], points_sensor: Array | None = None
) -> Array | None:
    """Return by how much points move (k, n, 3) [mm] with each mode of the rig's covariance, in the sensor frame.

    None where the rig states no covariance, or it is not known which devices gave the points (clouds of other
    scanners).

    Parameters
    ----------
    measurement : Measurement
        Points, and what gave them.
    pixels : ndarray (n, 2) int
        (u, v) of pixels; NaN where they hold no points.
    points_sensor : ndarray (n, 3) or None
        Points [mm] on the surface, seen at these pixels or between them; default the pixels' own.

    Notes
    -----
    A point of two cameras is where the ray of its pixel meets the surface that the other camera sees at the same
    projector position. Another rig moves the epipolar line; the corresponding pixel follows the line of equal projector
    position to it. So its place counts across that line, not along the epipolar one (`direction_px` of
    `point_derivatives`): where the two directions differ, an error across the epipolar lines moves points as well. A
    point of camera and projector keeps its projector column, its row, or, with both coded, their weighted mean.
    """
    if not states_errors(measurement):
        return None
    rig, own = measurement.rig, measurement.organised_on
    other, modes = rig.other(own), rig.modes()
    u, v = np.asarray(pixels).T
    own_points = measurement.points_sensor[v, u].astype(float)
    points = own_points if points_sensor is None else points_sensor
    moved = np.full((len(modes), len(points), 3), np.nan)
    left = np.isfinite(own_points[:, 2])
    if measurement.correspondence_px is not None and other is not None:
        seen = left & np.isfinite(measurement.correspondence_px[v, u, 0])
        across = _across_code_lines(measurement, u[seen], v[seen], points[seen])
        moved[:, seen] = _moved(rig, own, other, points[seen], across, modes)
        left &= ~seen
    if rig.projector is not None and measurement.projector_weights is not None and left.any():
        along = epipolar_motion(rig.cameras[own], rig.projector, points[left])
        weighted = np.array(measurement.projector_weights) * along
        moved[:, left] = _moved(rig, own, PROJECTOR, points[left], weighted, modes)
    return moved


def epipolar_motion(own: Camera, other: Camera, points_sensor: Array) -> Array:
    """Return the motion (n, 2) of points' images in `other` [px per mm] as the points (n, 3) move along their rays."""
    ray = points_sensor - own.center_sensor
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    _, by_point, _ = project_with_derivatives(other, points_sensor)
    return np.einsum("nij,nj->ni", by_point, ray)


def _moved(rig: Rig, own: str, other: str, points: Array, direction_px: Array, modes: Array) -> Array:
    by_parameter = point_derivatives(rig, own, other, points, rig.covariance_parameters, direction_px)
    return np.moveaxis(by_parameter @ modes.T, 2, 0)


def _across_code_lines(
    measurement: Measurement, u: NDArray[np.integer], v: NDArray[np.integer], points: Array
) -> Array:
    """Return the direction (n, 2) in the other camera's image across its lines of equal projector position."""
    other = measurement.rig.other(measurement.organised_on)
    assert other is not None
    along = epipolar_motion(measurement.camera, measurement.rig.cameras[other], points)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], -1)
    position = measurement.position_px
    if position is None or not len(points):
        return along
    assert measurement.correspondence_px is not None
    # d position / d q = (d position / d p) (d q / d p)^-1, p the own pixel and q the corresponding one.
    by_own = _gradient(position[..., None], u, v)[:, 0]
    other_by_own = _gradient(measurement.correspondence_px, u, v)
    with np.errstate(all="ignore"):
        determinant = np.linalg.det(other_by_own)[:, None, None]
        adjugate = np.empty_like(other_by_own)
        adjugate[:, 0, 0], adjugate[:, 1, 1] = other_by_own[:, 1, 1], other_by_own[:, 0, 0]
        adjugate[:, 0, 1], adjugate[:, 1, 0] = -other_by_own[:, 0, 1], -other_by_own[:, 1, 0]
        gradient = np.einsum("ni,nij->nj", by_own, adjugate / determinant)
        slope = (gradient * normal).sum(1) / (gradient * along).sum(1)
        good = np.abs(slope) < MAX_SLOPE
    # Beside gaps and jumps the lines run as elsewhere.
    slope[~good] = np.median(slope[good]) if good.any() else 0.0
    return np.asarray(along + slope[:, None] * normal)


def _gradient(image: Map, u: NDArray[np.integer], v: NDArray[np.integer]) -> Array:
    """Derivative (n, c, 2) of an image (H, W, c) along u and v at pixels (n,), over REACH_PX to both sides."""
    height, width = image.shape[:2]
    right, left = np.minimum(u + REACH_PX, width - 1), np.maximum(u - REACH_PX, 0)
    below, above = np.minimum(v + REACH_PX, height - 1), np.maximum(v - REACH_PX, 0)
    along_u = (image[v, right].astype(float) - image[v, left]) / (right - left)[:, None]
    along_v = (image[below, u].astype(float) - image[above, u]) / (below - above)[:, None]
    return np.stack([along_u, along_v], -1)
