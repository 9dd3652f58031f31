"""In how many ways the points of a board can be numbered: turns of the board that put its points onto its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array, compose, exp_so3
from planish.sensing.capture.board import Board, Charuco, board_points

#: Points meet under a turn within this share of the pitch.
MEETING = 0.01


@dataclass(frozen=True)
class Turn:
    """A turn of the board in its plane.

    Parameters
    ----------
    quarters : int
        By how many quarters of a circle.
    T_board_board : ndarray (4, 4)
        Moves point i to where point `becomes[i]` is.
    becomes : ndarray (N,) int
        The numbering after it.
    """

    quarters: int
    T_board_board: Array
    becomes: NDArray[np.intp]


def turns(board: Board) -> tuple[Turn, ...]:
    """Return all turns that the points alone do not tell apart, the first being none at all."""
    points = board_points(board)
    middle = 0.5 * (points.min(0) + points.max(0))
    found = []
    for quarters in range(1 if isinstance(board, Charuco) else 4):
        R = np.round(exp_so3([0.0, 0.0, quarters * np.pi / 2]))
        T = compose(R, middle - R @ middle)
        away = np.linalg.norm((points @ R.T + T[:3, 3])[:, None] - points, axis=2)
        becomes = away.argmin(1)
        if away.min(1).max() < MEETING * min(board.pitches_mm):
            found.append(Turn(quarters, T, becomes))
    return tuple(found)
