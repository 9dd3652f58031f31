"""A plausible calibration of the reference rig for tests of what is made of one: true places, drawn noise.

The residuals are drawn, not adjusted; the covariance is that of an adjustment with the same views, linear at the truth.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from planish.geometry import compose, exp_so3, invert, transform_points
from planish.measurement import Finding
from planish.rig import Rig
from planish.rig.derivatives import project_with_derivatives
from planish.rig.parameters import DEVICE_PARAMETERS, EXTERNAL
from planish.sensing.calibrate.observations import BoardObservations, BoardPoints, BoardView, CodedPoints
from planish.sensing.calibrate.result import Calibration, LensModel, Residuals
from planish.sensing.capture.board import board_points, parse_board
from planish.simulation.sensor import reference_rig

BOARD = {
    "schema": "planish.board/1", "kind": "chessboard", "corners": [14, 10], "pitch_mm": 15.0, "pitch_sigma": 1e-4,
}  # fmt: skip
LENS = ("k1", "k2", "p1", "p2")
INTRINSIC = ("fx", "fy", "cx", "cy", *LENS)
NOISE_PX = {"A": 0.05, "B": 0.06, "projector": 0.08}
MISSED = {"A/21.png": "no board found", "B/22.png": "12 of 140 points found, 14 needed"}
#: Every so many-th point is moved by OUTLIER_PX and marked.
OUTLIER_EVERY, OUTLIER_PX = 311, 0.9


def places(views: int, tilt_deg: float = 35.0, depth_mm: float = 60.0, shift: float = 1.0, seed: int = 0):
    """T_A_board of boards spread over the image and tilted about changing axes."""
    rng = np.random.default_rng(seed)
    rig = reference_rig()
    target = transform_points(rig.cameras["A"].T_camera_sensor, np.zeros((1, 3)))[0]
    points = board_points(parse_board(BOARD, "board"))
    middle = compose(np.eye(3), -points.mean(0))
    out = {}
    for i in range(views):
        axis = exp_so3([0, 0, 2.4 * i]) @ [1.0, 0, 0]
        R = exp_so3(np.radians(tilt_deg) * rng.uniform(0.4, 1) * axis)
        R = R @ exp_so3([0, 0, np.pi / 2 * (i % 2) + rng.uniform(-0.2, 0.2)])
        offset = shift * np.array([110 * np.cos(1.7 * i), 75 * np.sin(1.7 * i), 0]) * rng.uniform(0.3, 1)
        offset[2] = depth_mm * rng.uniform(-1, 1)
        out[f"view_{i:02d}"] = compose(R, target + offset) @ middle
    return out


def observe(rig, T_A_board, noise=NOISE_PX, seed=1):
    """Residuals per view and device, and the observations they belong to."""
    rng = np.random.default_rng(seed)
    board = parse_board(BOARD, "board")
    points = board_points(board)
    views, residuals = [], []
    for name, T in T_A_board.items():
        x = transform_points(T, points)
        cameras, code = {}, []
        for device, camera in rig.devices.items():
            pixel = camera.project(x)
            index = np.flatnonzero(((pixel > 2) & (pixel < np.array(camera.size_px) - 3)).all(-1))
            error = noise[device] * rng.standard_normal((len(index), 2))
            outlier = (index + 13 * len(views)) % OUTLIER_EVERY == 0
            error[outlier] += OUTLIER_PX * rng.choice([-1, 1], (outlier.sum(), 2))
            through = "A" if device == "projector" else None
            residuals.append(Residuals(name, device, through, index, pixel[index], error, outlier))
            sigma = np.full(len(index), noise[device])
            seen = BoardPoints(index, pixel[index] + error, sigma)
            if device == "projector":
                code.append(CodedPoints("A", index, rig.cameras["A"].project(x[index]), seen.pixel_px,
                                        np.broadcast_to(np.eye(2), (len(index), 2, 2)), sigma))  # fmt: skip
            else:
                cameras[device] = seen
        images = {device: f"{device}/{name[5:]}.png" for device in cameras}
        views.append(BoardView(name, cameras, tuple(code), images))
    projector_px = None if rig.projector is None else rig.projector.size_px
    sizes = {name: camera.size_px for name, camera in rig.cameras.items()}
    return BoardObservations(board, sizes, projector_px, tuple(views), MISSED), tuple(residuals)


def covariance(rig, T_A_board, residuals, noise=NOISE_PX, pitch_sigma=BOARD["pitch_sigma"]):
    """Covariance and names: intrinsics of all devices, places of all but A, scale; the boards' places eliminated."""
    names = [f"{d}.{p}" for d in rig.devices for p in (*INTRINSIC, *(() if d == "A" else EXTERNAL))]
    points = board_points(parse_board(BOARD, "board"))
    N = np.zeros((len(names), len(names)))
    for view, T in T_A_board.items():
        x = transform_points(T, points)
        own, cross, place = N * 0, np.zeros((len(names), 6)), np.zeros((6, 6))
        for r in (r for r in residuals if r.view == view):
            keep = r.index[~r.outlier]
            _, by_point, by_parameter = project_with_derivatives(rig.devices[r.device], x[keep])
            J = np.zeros((len(keep), 2, len(names)))
            for k, name in enumerate(names):
                device, _, parameter = name.partition(".")
                if device == r.device:
                    J[..., k] = by_parameter[..., DEVICE_PARAMETERS.index(parameter)]
            arm = x[keep] - x.mean(0)
            P = np.concatenate([np.cross(arm[:, None], by_point), by_point], -1).reshape(-1, 6) / noise[r.device]
            J = J.reshape(-1, len(names)) / noise[r.device]
            own, cross, place = own + J.T @ J, cross + J.T @ P, place + P.T @ P
        N += own - cross @ np.linalg.solve(place, cross.T)
    scale = np.zeros(len(names))
    for device, camera in rig.devices.items():
        if device != "A":
            scale[[names.index(f"{device}.{e}") for e in EXTERNAL[3:]]] = camera.T_camera_sensor[:3, 3]
    return np.linalg.inv(N) + pitch_sigma**2 * np.outer(scale, scale), tuple(names)


@lru_cache(maxsize=8)
def calibration(devices=("A", "B", "projector"), views=20, tilt_deg=35.0, depth_mm=60.0, shift=1.0, height=False):
    """A calibration of the devices of the reference rig."""
    whole = reference_rig().in_frame_of("A")
    rig = Rig(
        {name: whole.cameras[name] for name in devices if name != "projector"},
        whole.projector if "projector" in devices else None,
    )
    T_A_board = places(views, tilt_deg, depth_mm, shift)
    observations, residuals = observe(rig, T_A_board)
    C, names = covariance(rig, T_A_board, residuals)
    rig = replace(rig, covariance=C, covariance_parameters=names)
    models = {
        d: LensModel("radial + tangential", LENS,
                     {"none": 1.9, "radial": 0.101, "radial + tangential": 0.084, "rational": 0.0843},
                     "radial + tangential leaves boards out 0.084 px, radial 0.101 px, rational no less.")
        for d in rig.devices
    }  # fmt: skip
    findings = (
        Finding("pitch ratio y / x", 1.00002, 0.00003, "", "adjusted with the boards"),
        Finding("bending of the board", 0.012, 0.03, "mm", "sagitta over the longer side"),
        Finding("uniform scale", None, None, "", "boards alone do not show it; pitch_sigma of the board file counts"),
        Finding("board of view_03", 0.31, 0.05, "px", "residuals", "view_03 <fits badly>: was the board moved?"),
    )  # fmt: skip
    points = board_points(observations.board)
    bump = 0.05 * (1 - ((points[:, 0] - 97.5) / 97.5) ** 2) if height else None
    return Calibration(
        rig, observations, T_A_board, residuals, {d: NOISE_PX[d] for d in rig.devices}, models,
        {d: 1.55 * NOISE_PX[d] for d in rig.devices}, (0.0, BOARD["pitch_sigma"]), bump, findings,
        {"model": "auto", "flatness": height},
    )  # fmt: skip


def board_in_camera(item, view, camera):
    """T_camera_board of one view."""
    return (
        item.rig.cameras[camera].T_camera_sensor @ invert(item.rig.cameras["A"].T_camera_sensor) @ item.T_A_board[view]
    )
