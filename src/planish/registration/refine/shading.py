"""Gain, offset and slow shading between two textures: parameters of the fit, eliminated from its equations.

Another lamp, another exposure or room light that one picture has more of than the other change the contrast of a
texture. The low-pass of the contrast and its filter leave of that a factor and an offset that vary slowly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.refine.residuals import PRIOR, Equations, TileSums, around

#: Gain and offset are free in each square of so many tiles along both axes.
_CELL = 3
#: A gain of 1 is a contrast of 3 : 1: what differs by more is not one texture in two lights.
_MOST_GAIN = 1.0
#: What a cell's own sums say about gain and offset counts from this share of its largest on.
_EMPTY = 1e-9


def shading(sums: TileSums) -> Map:
    """Return by how much gain and offset (rows, columns, 2) of b's tiles differ from those that the sums hold.

    Least squares with the sums' robust weights over each tile and its neighbours; all tiles together count as much
    as some residuals of each, so that little texture says little.
    """
    share = PRIOR / max(float(sums.sizes[:, :, 1, 0].sum()), 1.0)
    S = around(sums.squares) + share * sums.squares.sum((0, 1))
    c = around(sums.residuals) + share * sums.residuals.sum((0, 1))
    found = _inverse(S) @ c[..., None]
    found[..., 0, 0] = np.clip(found[..., 0, 0], -_MOST_GAIN, _MOST_GAIN)
    return np.asarray(found[..., 0], np.float32)


def without_shading(e: Equations) -> Equations:
    """Return the equations of the transform alone: gain and offset of each cell are free, and eliminated.

    Notes
    -----
    Variable projection (Golub and Pereyra 1973): with J the derivatives by the transform and M those by gain and offset
    of a cell, H - J'WM (M'WM)^-1 M'WJ and g - J'WM (M'WM)^-1 M'Wr (Schur complement). The gradients of the tiles lose
    what their cell's gain and offset explain, and still add up to the whole.
    """
    change = _change(e.tile_shading)
    sums = e.sums
    inverse = _inverse(_cells(sums.squares))
    found = inverse @ _cells(sums.residuals)[..., None]
    of_cell = _cells(change)
    lost = np.einsum("rcip,rcpq,rcjq->ij", of_cell, inverse, of_cell)
    rows, columns = change.shape[:2]
    of_tile = np.repeat(np.repeat(found, _CELL, 0), _CELL, 1)[:rows, :columns]
    tiles = e.tile_gradients.copy()
    tiles[:, :, 1] -= (change @ of_tile)[..., 0]
    gone = (of_cell @ found)[..., 0].sum((0, 1))
    return replace(
        e, H_texture=e.H_texture - lost, H_texture_unbiased=e.H_texture_unbiased - lost, g_texture=e.g_texture - gone,
        tile_gradients=tiles,
    )  # fmt: skip


def _change(tile_shading: Array) -> Array:
    """J'WM (rows, columns, 6, 2) of the tiles."""
    return np.moveaxis(tile_shading[..., :12].reshape(*tile_shading.shape[:2], 2, 6), 2, 3)


def _cells(of_tiles: Array) -> Array:
    """Sums over the tiles of each cell."""
    rows, columns = of_tiles.shape[:2]
    down = np.add.reduceat(of_tiles, np.arange(0, rows, _CELL), axis=0)
    return np.asarray(np.add.reduceat(down, np.arange(0, columns, _CELL), axis=1))


def _inverse(squares: Array) -> Array:
    """Pseudoinverses (..., 2, 2) of sums of squares, gain and offset each in its own unit."""
    size = np.sqrt(np.einsum("...ii->...i", squares))
    outer = size[..., :, None] * size[..., None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.where(outer > 0, squares / outer, 0.0)
        return np.where(outer > 0, np.linalg.pinv(scaled, _EMPTY, hermitian=True) / outer, 0.0)
