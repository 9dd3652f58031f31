"""Which measurements overlap where a network has placed them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from planish.geometry import Array, transform_points
from planish.registration.candidates.footprint import Footprint

#: Side of a cell in distances of neighbouring points of footprints: some four points stand in each.
_CELL_SPACINGS = 2.0


@dataclass(frozen=True)
class Overlaps:
    """P pairs of measurements of the same group that share some surface.

    Parameters
    ----------
    index_a, index_b : ndarray (P,) int64
        Indices of the measurements, a < b, sorted.
    share : ndarray (P,)
        Common surface over the smaller one's, roughly.
    """

    index_a: NDArray[np.int64]
    index_b: NDArray[np.int64]
    share: Array


def find_overlaps(footprints: Sequence[Footprint], T_world: Array, group: NDArray[np.int64]) -> Overlaps:
    """Return which measurements overlap, by the cells of space that their surfaces share.

    Each cell counts by the cosine between both normals: the two sides of a sheet lie in the same cells. Time grows with
    the measurements and with how many see the same place, not with the number of pairs.

    Parameters
    ----------
    footprints : sequence of Footprint
    T_world : ndarray (n, 4, 4)
        Where each is placed in the world of its group.
    group : ndarray (n,) int64
        Measurements of different groups have no place relative to each other.
    """
    spacings = [float(item.spacing_mm) for item in footprints if len(item.points_sensor)]
    if not spacings:
        none = np.empty(0, np.int64)
        return Overlaps(none, none, np.empty(0))
    cell_mm = _CELL_SPACINGS * float(np.median(spacings))
    owner = np.repeat(np.arange(len(footprints)), [len(item.points_sensor) for item in footprints])
    points = np.concatenate(
        [transform_points(T, f.points_sensor.astype(float)) for T, f in zip(T_world, footprints, strict=True)]
    )
    normals = np.concatenate([f.normals_sensor @ T[:3, :3].T for T, f in zip(T_world, footprints, strict=True)])
    places = points / cell_mm
    # A plate that lies just where one grid divides lies in the middle of the other one's cells.
    shares = [_shares(np.floor(places + shift), normals, group, owner) for shift in (0.0, 0.5)]
    share = shares[0].maximum(shares[1]).tocoo()
    own = np.flatnonzero(share.row < share.col)
    own = own[np.lexsort((share.col[own], share.row[own]))]
    a, b = share.row[own].astype(np.int64), share.col[own].astype(np.int64)
    return Overlaps(a, b, np.asarray(share.data[own], float))


def _shares(places: Array, normals: Array, group: NDArray[np.int64], owner: NDArray[np.int64]) -> csr_array:
    """Return the shares (n, n) of common cells; `places` (N, 3) are the cells of the points of `owner` (N,)."""
    cell = _numbered(np.column_stack([group[owner], places]).astype(np.int64))
    shape = len(group), int(cell.max()) + 1
    points_in = csr_array((np.ones(len(owner)), (owner, cell)), shape)
    points_in.sum_duplicates()
    cells = np.diff(points_in.indptr)
    mean = [csr_array((normals[:, k].astype(float), (owner, cell)), shape) for k in range(3)]
    for part in mean:
        part.sum_duplicates()
        part.data /= points_in.data
    common = sum((part @ part.T for part in mean[1:]), mean[0] @ mean[0].T).tocoo()
    smaller = np.minimum(cells[common.row], cells[common.col])
    return csr_array((common.data / smaller, (common.row, common.col)), common.shape)


def _numbered(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number (N,) for each row of whole numbers (N, k), the same for the same rows, from 0 on."""
    number = np.zeros(len(places), np.int64)
    for column in places.T:
        own = np.unique(column, return_inverse=True)[1]
        # After each column as small as there are different rows: nothing overflows.
        number = np.unique(number * (own.max() + 1) + own, return_inverse=True)[1]
    return number
