"""Where the boards of a calibration were, as camera A sees them: distance, tilt, turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, transform_points
from planish.sensing.calibrate.result import Calibration
from planish.sensing.capture.board import board_points


@dataclass(frozen=True)
class Placement:
    """One view's board in the frame of camera A.

    Parameters
    ----------
    view : str
        Its name.
    distance_mm : float
        Depth of the board's centre along the camera's axis [mm].
    near_mm, far_mm : float
        Depths of its nearest and its farthest point that some device saw [mm].
    tilt_rad : float
        Angle between the board and the image plane [rad].
    lean : ndarray (2,)
        Components (right, down) in the image plane of the board's normal, which points to the camera.
    turn_rad : float
        Direction of the board's rows in the image [rad].
    """

    view: str
    distance_mm: float
    near_mm: float
    far_mm: float
    tilt_rad: float
    lean: Array
    turn_rad: float


def placements(calibration: Calibration) -> tuple[Placement, ...]:
    """Return where the boards were, in the order of the views."""
    points = board_points(calibration.observations.board)
    seen = {name: np.zeros(len(points), bool) for name in calibration.T_A_board}
    for r in calibration.residuals:
        seen[r.view][r.index[~r.outlier]] = True
    out = []
    for name, T in calibration.T_A_board.items():
        depth = np.asarray(transform_points(T, points)[:, 2])
        own = depth[seen[name]] if seen[name].any() else depth
        normal = T[:3, 2] * (1.0 if T[2, 2] >= 0 else -1.0)
        out.append(
            Placement(
                name,
                float(depth.mean()),
                float(own.min()),
                float(own.max()),
                float(np.arccos(min(1.0, normal[2]))),
                -normal[:2],
                float(np.arctan2(T[1, 0], T[0, 0])),
            )
        )
    return tuple(out)


def depths_mm(calibration: Calibration) -> tuple[float, float, float]:
    """Return nearest, median and farthest depth in camera A of the board points that count [mm].

    The median is what is called the working distance.
    """
    points = board_points(calibration.observations.board)
    depths = [
        transform_points(calibration.T_A_board[r.view], points[r.index[~r.outlier]])[:, 2]
        for r in calibration.residuals
    ]
    all_depths = np.concatenate(depths)
    return float(all_depths.min()), float(np.median(all_depths)), float(all_depths.max())
