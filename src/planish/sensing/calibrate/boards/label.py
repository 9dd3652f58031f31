"""Which point of the board is which: boards that look the same after a turn, and orders that run the wrong way."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.sensing.calibrate.boards.grid import apply_homography, fit_homography, homography_jacobian
from planish.sensing.calibrate.observations import BoardPoints, CodedPoints, Index
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Chessboard, board_points

Points = TypeVar("Points", BoardPoints, CodedPoints)


def order_of_points(board: Board, pixels: Array) -> Index | None:
    """Return which point of the board each of the pixels (N, 2) is, as found row by row from some corner of the grid.

    The board is seen from its front: where columns and rows run so that it would be seen from behind, the order is
    mirrored. Of the orders that remain the one with its columns most to the right in the image is taken. None where no
    order fits.
    """
    columns, rows = board.grid
    place = np.arange(columns * rows).reshape(rows, columns)
    orders = [place[::a, ::b] for a, b in product((1, -1), (1, -1))]
    if columns == rows:
        orders += [order.T for order in orders]
    if isinstance(board, AsymmetricCircles) and rows % 2 == 0:
        # OpenCV may take a grid that starts with the row that stands out, and exchange each two rows.
        orders += [order[np.arange(rows) ^ 1] for order in orders]
    points = board_points(board)[:, :2]
    best: tuple[float, Index] | None = None
    for order in orders:
        index = order.ravel()
        H = fit_homography(points[index], pixels)
        if H is None:
            continue
        middle = points.mean(0)
        J = homography_jacobian(H, middle[None])[0]
        error = np.median(np.linalg.norm(apply_homography(H, points[index]) - pixels, axis=1))
        if np.linalg.det(J) <= 0 or error > 0.3 * np.sqrt(abs(np.linalg.det(J)) * np.prod(board.pitches_mm)):
            continue
        to_right = J[0, 0] / np.hypot(*J[:, 0])
        if best is None or to_right > best[0]:
            best = (to_right, index)
    return None if best is None else best[1]


def matches_colours(board: Board, index: Index, dark: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which crossings (n,) have the colours that the board's print gives them; circles have none."""
    if not isinstance(board, (Chessboard, Charuco)):
        return np.ones(len(index), bool)
    columns, rows = board.grid
    first_dark = not (isinstance(board, Charuco) and board.legacy and (rows + 1) % 2 == 0)
    return np.asarray(((index % columns + index // columns) % 2 == 0) == (dark == first_dark))


def renamed(points: Points, turn: Index) -> Points:
    """Return the points after a turn of the board (see `names_alike`), in the order of their new index."""
    index = turn[points.index]
    order = np.argsort(index)
    arrays = {f.name: getattr(points, f.name)[order] for f in fields(points) if f.name not in ("index", "camera")}
    return replace(points, index=index[order], **arrays)
