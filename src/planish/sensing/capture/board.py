"""The calibration board: what is printed on it, in millimetres, and its file `board.json` (schema planish.board/1)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PositiveFloat

from planish import storage
from planish.geometry import Array
from planish.options import Strict

#: Relative standard deviation of the pitch where the file states none: 0.1 mm in a metre, a good print on a plate.
PITCH_SIGMA = 1e-4

#: (columns, rows), counted as each board's field says.
Count = tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]]


class KnownLength(Strict):
    """A length between two points of the board that was measured by other means, by their (column, row)."""

    first: tuple[int, int]
    second: tuple[int, int]
    length_mm: PositiveFloat
    sigma_mm: PositiveFloat


class _Printed(Strict):
    schema_: Literal["planish.board/1"] = Field(alias="schema")
    #: Distance of neighbouring points [mm]: one number, or along columns and rows.
    pitch_mm: PositiveFloat | tuple[PositiveFloat, PositiveFloat]
    #: Relative standard deviation of the uniform scale of the pitch.
    pitch_sigma: float = Field(default=PITCH_SIGMA, ge=0)
    known_length: KnownLength | None = None

    @property
    def pitches_mm(self) -> tuple[float, float]:
        """Pitch along x and y [mm]."""
        return self.pitch_mm if isinstance(self.pitch_mm, tuple) else (self.pitch_mm, self.pitch_mm)


class Chessboard(_Printed):
    """A chessboard; its points are the inner corners, `corners` = (columns, rows) of them."""

    kind: Literal["chessboard"]
    corners: Count

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of the points."""
        return self.corners


class Charuco(_Printed):
    """A ChArUco board of `squares` = (columns, rows); its points are the inner corners.

    `legacy` tells OpenCV's layouts apart: True for boards made before OpenCV 4.6 with an even number of rows, whose
    first square is white with a marker.
    """

    kind: Literal["charuco"]
    squares: Count
    marker_mm: PositiveFloat
    dictionary: str = "4X4_50"
    legacy: bool = False

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of the points."""
        return (self.squares[0] - 1, self.squares[1] - 1)


class Circles(_Printed):
    """A grid of dark or light discs, `circles` = (columns, rows); its points are their centres.

    Without `diameter_mm` the shift of a disc's image against that of its centre is not corrected.
    """

    kind: Literal["circles"]
    circles: Count
    diameter_mm: PositiveFloat | None = None

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of the points."""
        return self.circles


class AsymmetricCircles(_Printed):
    """OpenCV's asymmetric grid: disc j of row i at ((2 j + i % 2) pitch_x, i pitch_y), `circles` = (per row, rows)."""

    kind: Literal["asymmetric_circles"]
    circles: Count
    diameter_mm: PositiveFloat | None = None

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of the points."""
        return self.circles


Board = Annotated[Chessboard | Charuco | Circles | AsymmetricCircles, Field(discriminator="kind")]


class _BoardFile(Strict):
    board: Board


def parse_board(content: Any, subject: str) -> Board:
    """Return the board that the content of a `board.json` describes; errors name `subject`."""
    return _BoardFile.parse({"board": content}, subject).board


def load_board(path: Path) -> Board:
    """Read `board.json`; errors name the file."""
    return parse_board(storage.read_json(Path(path)), str(path))


def board_points(board: Board) -> Array:
    """Return the points (N, 3) [mm] in the board's frame, z = 0, row by row: x along the columns, y along the rows.

    Point `row * columns + column` is the board's point (column, row). z points into the board, away from the sensor.
    """
    columns, rows = board.grid
    j, i = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    if isinstance(board, AsymmetricCircles):
        j = 2 * j + i % 2
    x, y = board.pitches_mm
    return np.column_stack([j.ravel() * x, i.ravel() * y, np.zeros(columns * rows)])
