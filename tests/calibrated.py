"""The covariance that a rig has after a calibration with boards, from derivatives alone: no images, no adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planish.geometry import Array, exp_se3
from planish.rig import Rig
from planish.rig.derivatives import project_with_derivatives
from planish.rig.parameters import EXTERNAL, selection

#: Standard deviation of a corner in a camera and of its code in the projector [px].
CORNER_PX = 0.05
#: Relative standard deviation of the board's pitch, that is of all lengths.
PITCH_SIGMA = 1e-4
VIEWS = 20
#: Corners of the board along both axes, and their pitch [mm].
BOARD, PITCH_MM = (12, 9), 22.0
FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def board_places(seed: int = 0, views: int = VIEWS) -> list[Array]:
    """T_sensor_board (4, 4) of boards all over the reference sensor's field, tilted by up to 35 degrees."""
    rng = np.random.default_rng(seed)
    tilts, shifts = rng.uniform(-0.6, 0.6, (views, 2)), rng.uniform(-1, 1, (views, 3)) * [70, 50, 60]
    return [
        exp_se3([0, 0, 0, *d]) @ exp_se3([*t, rng.uniform(-1, 1), 0, 0, 0]) for t, d in zip(tilts, shifts, strict=True)
    ]


def board_points() -> Array:
    """Corners (n, 3) of the board about its middle [mm]."""
    u, v = np.meshgrid(*(PITCH_MM * (np.arange(n) - (n - 1) / 2) for n in BOARD))
    return np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])


def with_calibration(rig: Rig, seed: int = 0, corner_px: float = CORNER_PX, pitch_sigma: float = PITCH_SIGMA) -> Rig:
    """Return the rig with the covariance of a calibration by 20 boards; the sensor frame goes with camera A.

    Each board's place is eliminated from the information by its Schur complement; corners outside a device's image do
    not count. The pitch's uncertainty changes all distances from camera A alike.
    """
    devices = rig.devices
    names = tuple(f"{device}.{name}" for device in devices for name in FREE + (EXTERNAL if device != "A" else ()))
    picks = selection(names, tuple(devices))
    information = np.zeros((len(names), len(names)))
    for T in board_places(seed):
        points = board_points() @ T[:3, :3].T + T[:3, 3]
        lever = points - T[:3, 3]
        by_place = np.concatenate([-_skew(lever), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
        rows, place_rows = [], []
        for device, camera in devices.items():
            pixels, by_point, by_parameter = project_with_derivatives(camera, points)
            seen = ((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1)).all(1)
            rows.append((by_parameter @ picks[device])[seen].reshape(-1, len(names)))
            place_rows.append((by_point @ by_place)[seen].reshape(-1, 6))
        J, P = np.concatenate(rows) / corner_px, np.concatenate(place_rows) / corner_px
        information += J.T @ J - J.T @ P @ np.linalg.solve(P.T @ P, P.T @ J)
    scale = 1 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    # x_device grows with all distances from A: the device's translation changes by where it sees A's centre.
    center = rig.cameras["A"].center_sensor
    growth = np.zeros(len(names))
    for device, camera in devices.items():
        if device != "A":
            at = [names.index(f"{device}.translation_{axis}") for axis in "xyz"]
            growth[at] = camera.T_camera_sensor[:3, :3] @ center + camera.T_camera_sensor[:3, 3]
    covariance = covariance + pitch_sigma**2 * np.outer(growth, growth)
    return replace(rig, covariance=(covariance + covariance.T) / 2, covariance_parameters=names)


def drawn(rig: Rig, seed: int) -> Rig:
    """Return a rig with an error drawn from the covariance of `rig`, which it states as its own."""
    modes = rig.modes()
    return rig.changed(np.random.default_rng(seed).standard_normal(len(modes)) @ modes)


def _skew(v: Array) -> Array:
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v.T
    return out - out.transpose(0, 2, 1)
