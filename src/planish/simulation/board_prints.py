"""The print of each kind of board, in stated millimetres from point (0, 0): x along the columns, y along the rows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.geometry import Array
from planish.sensing.capture.board import AsymmetricCircles, Charuco, Chessboard, Circles

Cells = tuple[Array, Array, NDArray[np.bool_]]

#: Diameter of discs over the shorter pitch where the board's file states none.
DISC_SHARE = 0.5


def chessboard_cells(board: Chessboard) -> Cells:
    """Return the lines x (columns + 1,), y (rows + 1,) [mm] and the dark squares (rows, columns), the first is dark."""
    columns, rows = board.corners[0] + 1, board.corners[1] + 1
    x, y = board.pitches_mm
    row, column = np.mgrid[:rows, :columns]
    dark: NDArray[np.bool_] = (row + column) % 2 == 0
    return np.arange(-1.0, columns) * x, np.arange(-1.0, rows) * y, dark


def charuco_cells(board: Charuco) -> Cells:
    """Return the lines x, y [mm] of squares and marker modules, and the dark cells between them.

    Raises
    ------
    InputError
        Where OpenCV has no such dictionary, it has too few markers, or they do not fit into the squares.

    Notes
    -----
    Layout: OpenCV, objdetect, CharucoBoard. Markers stand in the white squares, numbered row by row; the first square
    is dark, but white in a legacy board with an even number of rows.
    """
    dictionary = marker_dictionary(board)
    modules = dictionary.markerSize + 2
    columns, rows = board.squares
    row, column = np.mgrid[:rows, :columns]
    first_white = board.legacy and rows % 2 == 0
    dark_square = (row + column) % 2 == (1 if first_white else 0)
    # A square's cells: margin, modules of the marker with its dark border, margin.
    cells = np.repeat(np.repeat(dark_square, modules + 2, 0), modules + 2, 1)
    for number, (i, j) in enumerate(np.argwhere(~dark_square)):
        marker = cv2.aruco.generateImageMarker(dictionary, number, modules) == 0
        top, left = i * (modules + 2) + 1, j * (modules + 2) + 1
        cells[top : top + modules, left : left + modules] = marker
    lines = [
        _square_lines(count, pitch, board.marker_mm, modules)
        for count, pitch in zip(board.squares, board.pitches_mm, strict=True)
    ]
    return lines[0], lines[1], cells


def marker_dictionary(board: Charuco) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of a board's markers; raises InputError as `charuco_cells` does."""
    number = getattr(cv2.aruco, f"DICT_{board.dictionary}", None)
    if not isinstance(number, int):
        known = ", ".join(sorted(name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_")))
        raise InputError("board: dictionary", f"found '{board.dictionary}'", f"one of OpenCV's: {known}")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    needed = int(board.squares[0] * board.squares[1] / 2)
    if len(dictionary.bytesList) < needed:
        raise InputError("board: dictionary", f"'{board.dictionary}' has {len(dictionary.bytesList)} markers",
                         f"at least {needed} for {board.squares} squares")  # fmt: skip
    if board.marker_mm >= min(board.pitches_mm):
        raise InputError("board: marker_mm", f"found {board.marker_mm:g}", f"less than {min(board.pitches_mm):g} mm")
    return dictionary


def _square_lines(count: int, pitch: float, marker: float, modules: int) -> Array:
    inner = np.concatenate([[0.0], (pitch - marker) / 2 + np.arange(modules + 1) * marker / modules])
    lines = (np.arange(count)[:, None] - 1) * pitch + inner
    return np.append(lines.ravel(), (count - 1) * pitch)


def disc_radius_mm(board: Circles | AsymmetricCircles) -> float:
    """Return the radius of a board's discs [mm]."""
    return (board.diameter_mm or DISC_SHARE * min(board.pitches_mm)) / 2
