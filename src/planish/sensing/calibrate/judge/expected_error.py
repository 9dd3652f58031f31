"""The 3D error that the covariance of a calibration lets one expect, as a map over the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Map
from planish.rig import Camera, Rig
from planish.rig.derivatives import point_derivatives
from planish.sensing.calibrate.judge.views import depths_mm
from planish.sensing.calibrate.result import Calibration

#: Places per image width of a map: its errors vary as slowly as distortions do.
COLUMNS = 64


@dataclass(frozen=True)
class ExpectedError:
    """Standard deviations of measured points by the calibration alone (h, w); NaN where there is no point.

    Parameters
    ----------
    own, other : str
        Devices that give the points: the organising camera, and the other camera or "projector".
    pixel_px : ndarray (h, w, 2)
        Pixels of the organising camera.
    points_sensor : ndarray (h, w, 3)
        Points there [mm].
    sensor_mm : ndarray (h, w)
        Root mean square length of the error in the sensor frame [mm].
    form_mm : ndarray (h, w)
        The same after the rigid motion that takes most of the error off the whole map: what an inspection sees [mm].
    scale_mm : ndarray (h, w)
        The part of `form_mm` that is one factor on all lengths [mm].
    scale_sigma : float
        Standard deviation of that factor (a share of 1).
    """

    own: str
    other: str
    pixel_px: Array
    points_sensor: Array
    sensor_mm: Array
    form_mm: Array
    scale_mm: Array
    scale_sigma: float

    @property
    def warp_mm(self) -> Array:
        """Root mean square (h, w) over the map's modes of `form_mm` without `scale_mm` [mm]."""
        return np.sqrt(np.maximum(self.form_mm**2 - self.scale_mm**2, 0.0))


def map_rms(values: Array) -> float:
    """Return the root mean square of a map where it is not NaN; NaN without any value."""
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if len(known) else float("nan")


def device_pairs(rig: Rig) -> tuple[tuple[str, str], ...]:
    """Return the pairs (organising camera, other device) that a rig measures with."""
    return tuple(("A", name) for name in rig.devices if name != "A")


def expected_errors(calibration: Calibration) -> tuple[ExpectedError, ...]:
    """Return the expected error of each pair of devices on a plane at the working distance of the boards."""
    depth = depths_mm(calibration)[1]
    return tuple(
        expected_error_on_plane(calibration.rig, own, other, depth) for own, other in device_pairs(calibration.rig)
    )


def pixel_grid(camera: Camera, columns: int = COLUMNS) -> Array:
    """Return pixels (h, w, 2) spread evenly over a camera's image, its borders half a step away."""
    width, height = camera.size_px
    rows = max(2, round(columns * height / width))
    u = (np.arange(columns) + 0.5) * width / columns - 0.5
    v = (np.arange(rows) + 0.5) * height / rows - 0.5
    return np.stack(np.meshgrid(u, v), -1)


def points_at_depth(camera: Camera, pixel_px: Array, depth_mm: ArrayLike) -> Array:
    """Return the points (h, w, 3) in the sensor frame at pixels (h, w, 2) of a camera.

    `depth_mm` (h, w), or one number for a plane parallel to the image, is measured along the camera's axis.
    """
    depth = np.broadcast_to(np.asarray(depth_mm, float), pixel_px.shape[:2])
    return camera.center_sensor + camera.rays_sensor(pixel_px) * depth[..., None]


def expected_error_on_plane(
    rig: Rig, own: str, other: str, depth_mm: float, direction_px: ArrayLike | None = None, columns: int = COLUMNS
) -> ExpectedError:
    """Return the expected error on a plane parallel to the organising camera's image, `depth_mm` in front of it."""
    pixels = pixel_grid(rig.cameras[own], columns)
    return expected_error(rig, own, other, pixels, points_at_depth(rig.cameras[own], pixels, depth_mm), direction_px)


def expected_error(
    rig: Rig,
    own: str,
    other: str,
    pixel_px: Array,
    points_sensor: NDArray[np.floating] | Map,
    direction_px: ArrayLike | None = None,
) -> ExpectedError:
    """Return the error of measured points that the covariance of the rig lets one expect.

    Parameters
    ----------
    rig : Rig
        With covariance.
    own, other : str
        Devices that give the points: the organising camera, and the other camera or "projector".
    pixel_px : ndarray (h, w, 2)
        Pixels of the organising camera; for the record.
    points_sensor : ndarray (h, w, 3)
        The points at these pixels [mm], NaN where there is none. Points that the other device does not see are left
        out.
    direction_px : array_like (2,) or None
        Direction along which the other device's position counts: (1, 0) for a projector that codes its columns alone.
        Default: along the epipolar line.

    Raises
    ------
    InputError
        Where the rig has no covariance.

    Notes
    -----
    Each mode of the covariance moves the points by d_k (N, 3), to first order; the error of a point has the mean
    square sum_k |d_k|^2. Of each mode the rigid motion of the whole map that is nearest to it in the least-squares
    sense is taken off (every pixel with equal weight), and then the factor about the centroid: the two are orthogonal,
    because a factor neither moves the centroid nor turns anything.
    """
    if rig.covariance is None:
        raise InputError("rig", "it has no covariance", "a rig whose calibration states one")
    points = np.asarray(points_sensor, float)
    seen = np.isfinite(points).all(-1)
    seen[seen] = in_image(rig.devices[other], points[seen])
    x = points[seen]
    direction = None if direction_px is None else np.asarray(direction_px, float)
    J = point_derivatives(rig, own, other, x, rig.covariance_parameters, direction)
    moved = np.einsum("nij,kj->kni", J, rig.modes())
    form, factors, arm = _without_rigid_motion(moved, x)

    def on_map(values: Array) -> Array:
        out = np.full(seen.shape, np.nan)
        out[seen] = values
        return out

    scale_sigma = float(np.sqrt((factors**2).sum()))
    return ExpectedError(
        own,
        other,
        pixel_px,
        np.where(seen[..., None], points, np.nan),
        on_map(np.sqrt((moved**2).sum((0, 2)))),
        on_map(np.sqrt((form**2).sum((0, 2)))),
        on_map(scale_sigma * np.linalg.norm(arm, axis=1)),
        scale_sigma,
    )


def in_image(camera: Camera, points_sensor: Array) -> NDArray[np.bool_]:
    """Return which points (N, 3) a device sees or lights."""
    pixel = camera.project(points_sensor)
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixel >= -0.5) & (pixel <= np.array(camera.size_px) - 0.5)).all(-1))


def _without_rigid_motion(moved: Array, x: Array) -> tuple[Array, Array, Array]:
    """Displacements (k, n, 3) less their rigid part, factor (k,) on the lengths of each, and arms (n, 3) [mm]."""
    if len(x) < 3:
        return np.zeros_like(moved), np.zeros(len(moved)), np.zeros_like(x)
    arm = x - x.mean(0)
    size = np.sqrt((arm**2).sum(1).mean())
    # Six rigid fields: three translations, omega x arm; the arms scaled to 1 for the condition of the equations.
    turn = np.cross(np.eye(3)[:, None], arm[None] / size)
    fields = np.concatenate([np.broadcast_to(np.eye(3)[:, None], turn.shape), turn]).reshape(6, -1).T
    flat = moved.reshape(len(moved), 3 * len(x)).T
    q, _ = np.linalg.qr(fields)
    form = (flat - q @ (q.T @ flat)).T.reshape(moved.shape)
    factors = np.einsum("kni,ni->k", form, arm) / (arm**2).sum()
    return form, factors, arm
