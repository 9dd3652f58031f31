"""Boards as devices see them, drawn from a rig: the input of a calibration with known truth."""

import numpy as np

from planish.geometry import compose, exp_so3, transform_points
from planish.sensing.calibrate.observations import BoardObservations, BoardPoints, BoardView, CodedPoints
from planish.sensing.capture.board import board_points, parse_board

BOARD = {"schema": "planish.board/1", "kind": "chessboard", "corners": (11, 8), "pitch_mm": 18.0}


def board(**changes):
    return parse_board({**BOARD, **changes}, "board")


def places(count, rng, tilt_deg=(15.0, 40.0), depth_mm=40.0, shift_mm=(35.0, 25.0), points=None):
    """T_sensor_board of boards about the reference sensor's origin; z points into the board, away from the sensor."""
    center = (board_points(board()) if points is None else points).mean(0)
    found = []
    for _ in range(count):
        axis, angle = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*tilt_deg))
        R = exp_so3(angle * np.array([np.cos(axis), np.sin(axis), 0.0])) @ exp_so3([0, 0, rng.uniform(-0.4, 0.4)])
        R = R @ np.diag([1.0, -1.0, -1.0])
        t = np.array([*rng.uniform(-1, 1, 2) * shift_mm, rng.uniform(-depth_mm, depth_mm)])
        found.append(compose(R, t - R @ center))
    return found


def in_image(pixel, size_px, margin=5.0):
    return (np.isfinite(pixel) & (pixel > margin) & (pixel < np.array(size_px) - 1 - margin)).all(-1)


def observe(rig, T_sensor_board, rng, noise_px=0.05, code_px=0.05, item=None, points=None, devices=("A", "B")):
    """Observations of the board `item` whose true points are `points`."""
    item = board() if item is None else item
    points = board_points(item) if points is None else points
    views = []
    for number, T in enumerate(T_sensor_board):
        seen = transform_points(T, points)
        cameras, code = {}, []
        for name in (name for name in devices if name != "projector"):
            camera = rig.cameras[name]
            exact = camera.project(seen)
            index = np.flatnonzero(in_image(exact, camera.size_px))
            if len(index) < 10:
                continue
            pixel = exact[index] + noise_px * rng.standard_normal((len(index), 2))
            cameras[name] = BoardPoints(index, pixel, np.full(len(index), 0.1))
            if "projector" in devices:
                code.append(coded(rig, name, T, points, index, pixel, rng, code_px))
        images = {name: f"{name}/{number:02}.png" for name in cameras}
        views.append(BoardView(f"{number:02}", cameras, tuple(code), images))
    sizes = {name: rig.cameras[name].size_px for name in devices if name != "projector"}
    projector = rig.projector.size_px if "projector" in devices else None
    return BoardObservations(item, sizes, projector, tuple(views), {})


def coded(rig, name, T_sensor_board, points, index, pixel, rng, code_px):
    """What the projector's code says near the points: its position at the noisy corners, with the local slope."""
    camera, projector = rig.cameras[name], rig.projector

    def position(at):
        rays = camera.rays_sensor(at)
        normal, origin = T_sensor_board[:3, 2], T_sensor_board[:3, 3]
        away = ((points[index] @ T_sensor_board[:3, :3].T + origin - camera.center_sensor) * normal).sum(1)
        return projector.project(camera.center_sensor + rays * (away / (rays @ normal))[:, None])

    step = 0.5 * np.eye(2)
    slope = np.stack([position(pixel + s) - position(pixel - s) for s in step], -1)
    noisy = position(pixel) + code_px * rng.standard_normal((len(index), 2))
    kept = in_image(noisy, projector.size_px, 0.0)
    return CodedPoints(name, index[kept], pixel[kept], noisy[kept], slope[kept], np.full(int(kept.sum()), 0.1))
