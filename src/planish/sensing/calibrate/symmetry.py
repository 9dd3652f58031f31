"""In how many ways the points of a board can be named: turns of the board that put its points onto its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, compose, exp_so3
from planish.sensing.calibrate.observations import Index
from planish.sensing.capture.board import Board, Charuco, Chessboard, board_points

#: Points meet under a turn within this share of the pitch.
MEETING = 1e-3


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
    keeps_colours : bool
        Whether dark squares come onto dark ones: the board looks the same then.
    """

    quarters: int
    T_board_board: Array
    becomes: Index
    keeps_colours: bool


def turns(board: Board) -> tuple[Turn, ...]:
    """Return all turns that the points alone do not tell apart, the first being none at all.

    Pitches along x and y that differ do not make a board look different enough to rely on: points are counted in them.
    """
    points = board_points(board)
    middle = 0.5 * (points.min(0) + points.max(0))
    grid = (points - middle) / np.array([*board.pitches_mm, 1.0])
    found = []
    for quarters in range(1 if isinstance(board, Charuco) else 4):
        R = np.round(exp_so3([0.0, 0.0, quarters * np.pi / 2]))
        away = np.linalg.norm((grid @ R.T)[:, None] - grid, axis=2)
        becomes = away.argmin(1)
        if away.min(1).max() < MEETING:
            T = compose(R, middle - R @ middle)
            found.append(Turn(quarters, T, becomes, _same_colours(board, becomes, quarters)))
    return tuple(found)


def names_alike(board: Board) -> tuple[Index, ...]:
    """Return the numberings after all turns that leave the board's looks as they are, the first being its own."""
    return tuple(turn.becomes for turn in turns(board) if turn.keeps_colours)


def _same_colours(board: Board, becomes: Index, quarters: int) -> bool:
    if not isinstance(board, Chessboard):
        return True
    # The square to the right of a crossing and below it is dark where column + row is even. A turn by 90 degrees brings
    # it to the side, where it is of the other colour.
    columns = board.grid[0]
    before, after = ((index % columns + index // columns) % 2 for index in (np.arange(len(becomes)), becomes))
    same = before == after
    return bool(same.all() if quarters % 2 == 0 else not same.any())
