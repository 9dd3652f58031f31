"""Regular patterns on a blank plate: chessboards and rasters of dots, with and without an end."""

from __future__ import annotations

from typing import Literal

import numpy as np

from planish.simulation.printed import Print, raster_print

#: Reflectance of the dark over that of the plate, and radius of a dot over the pitch.
DARK, DOT_SHARE = 0.3, 0.3

Pattern = Literal["chessboard", "dots"]


def pattern_print(pattern: Pattern, pitch_mm: float, columns: int, rows: int, endless: bool) -> Print:
    """Return squares of a chessboard or dots of a raster, so many about the middle of the surface, or everywhere."""
    if endless:
        columns = rows = 2
    size = np.array([columns, rows]) * pitch_mm
    if pattern == "chessboard":
        dark = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0
        origin = (float(-size[0] / 2), float(size[1] / 2))
        return raster_print(np.where(dark, DARK, 1.0), (pitch_mm, pitch_mm), origin, (endless, endless))
    x, y = (pitch_mm * np.arange(n + 1) for n in (columns, rows))
    at = np.stack(np.meshgrid(x[:-1], y[:-1]), -1).reshape(-1, 2) + pitch_mm / 2
    discs = np.column_stack([at, np.full(len(at), DOT_SHARE * pitch_mm), np.full(len(at), DARK)])
    to_print = np.array([[1.0, 0.0, size[0] / 2], [0.0, -1.0, size[1] / 2]])
    return Print(x, y, np.ones((rows, columns)), discs, to_print, (endless, endless))
