"""Residuals of a problem, how they change with what is free, and the step that a change makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, exp_se3
from planish.rig import Camera
from planish.rig.derivatives import project_with_derivatives
from planish.rig.parameters import DEVICE_PARAMETERS, change_camera
from planish.sensing.calibrate.adjust.discs import disc_shift
from planish.sensing.calibrate.adjust.problem import Block, Free, Problem, State
from planish.sensing.calibrate.observations import Index

#: Free numbers of one place of the board: rotation [rad] and translation [mm] in its own frame, about its middle.
PLACE = 6
#: Points are kept this far in front of a device [mm] while a step of the adjustment may put them behind it.
NEAREST_MM = 1.0


@dataclass(frozen=True)
class Linear:
    """Residuals of a block and their derivatives, in the views that it sees.

    Parameters
    ----------
    rows : ndarray (R,) int
        The views.
    columns : ndarray (c,) int
        Columns of the parameter vector.
    residual_px : ndarray (R, N, 2)
        Observed less predicted; 0 where not seen.
    jacobian : ndarray (R, N, 2, c + PLACE)
        Derivative of the prediction by these columns and by the view's place.
    """

    rows: Index
    columns: Index
    residual_px: Array
    jacobian: Array


def linearise(problem: Problem, state: State, free: Free, block: Block) -> Linear:
    """Return residuals and derivatives of one block."""
    rows = np.flatnonzero(block.views)
    T = state.T_sensor_board[rows]
    board = (
        problem.points_board + np.tensordot(state.amplitudes, problem.modes, 1) if free.modes else problem.points_board
    )
    points = board @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    predicted, by_point, parts = _project(state.devices[block.device], points, free.places[block.device])
    columns = [free.columns(block.device)]
    jacobian_parts = [parts]
    if block.through is None and problem.disc_radius_mm is not None:
        predicted = predicted + disc_shift(state.devices[block.device], points, T, problem.disc_radius_mm)
    elif block.through is not None:
        assert block.camera_px is not None
        assert block.jacobian is not None
        pixel, through_point, through_parts = _project(state.devices[block.through], points, free.places[block.through])
        D = -block.jacobian[rows]
        predicted = predicted + (D @ (pixel - block.camera_px[rows])[..., None])[..., 0]
        by_point = by_point + D @ through_point
        jacobian_parts.append(D @ through_parts)
        columns.append(free.columns(block.through))
    by_board = by_point @ T[:, None, :3, :3]
    if free.modes:
        jacobian_parts.append(np.einsum("vnij,knj->vnik", by_board, problem.modes))
        columns.append(free.mode_columns)
    turning = np.cross((board - problem.center)[:, None], by_board)
    seen = block.seen[rows][..., None]
    jacobian = np.concatenate([*jacobian_parts, turning, by_board], -1)
    residual = np.where(seen, block.observed_px[rows] - predicted, 0.0)
    return Linear(rows, np.concatenate(columns), residual, np.where(seen[..., None], jacobian, 0.0))


def _project(camera: Camera, points: Array, places: Sequence[int]) -> tuple[Array, Array, Array]:
    """Pixels (R, N, 2) of points (R, N, 3) and their derivatives, with points held in front of the device."""
    T = camera.T_camera_sensor
    flat = points.reshape(-1, 3)
    depth = flat @ T[2, :3] + T[2, 3]
    if depth.min(initial=np.inf) < NEAREST_MM:
        flat = flat + np.maximum(NEAREST_MM - depth, 0.0)[:, None] * T[2, :3]
    pixel, by_point, by_parameter = project_with_derivatives(camera, flat, places)
    shape = points.shape[:2]
    return pixel.reshape(*shape, 2), by_point.reshape(*shape, 2, 3), by_parameter.reshape(*shape, 2, len(places))


def moved(problem: Problem, state: State, free: Free, change: Array, places: Array) -> State:
    """Return the state after a step: `change` (C,) of the parameters, `places` (V, PLACE) of the board."""
    devices = dict(state.devices)
    for device, own in free.places.items():
        full = np.zeros(len(DEVICE_PARAMETERS))
        full[list(own)] = change[free.columns(device)]
        devices[device] = change_camera(devices[device], full)
    center = problem.center
    T = state.T_sensor_board.copy()
    for v in np.flatnonzero(places.any(1)):
        # T Trans(c) Exp(xi) Trans(-c)
        step = exp_se3(places[v])
        step[:3, 3] += center - step[:3, :3] @ center
        T[v] = T[v] @ step
    amplitudes = state.amplitudes + change[free.mode_columns] if free.modes else state.amplitudes
    return State(devices, T, amplitudes)
