"""Tiles of about 10 mm on a measurement's pixel grid: one in five is kept out of every fit, to judge it afterwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish.measurement import Measurement

#: Edge of a tile [mm] (DESIGN section 4, "Errors").
TILE_MM = 10.0
#: Tiles per width of the image at least: a sensor with a small field needs enough of them all the same.
MIN_TILES = 24


def ground_sample_distance(measurement: Measurement) -> float:
    """Return the median distance on the surface between neighbouring pixels [mm per pixel]."""
    return measurement.sample_distance_mm


def tile_size_px(measurement: Measurement) -> int:
    """Return the edge of a tile in pixels of the organising camera: 10 mm, less for small fields, at least 4."""
    gsd = ground_sample_distance(measurement)
    largest = measurement.shape[1] // MIN_TILES
    return max(4, min(round(TILE_MM / gsd), largest)) if np.isfinite(gsd) else 4


def held_out(tile_row: NDArray[np.integer], tile_column: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return which tiles take no part in any fit: one in five, a knight's move apart, so that none are neighbours."""
    return np.asarray((tile_row + 2 * tile_column) % 5 == 0)
