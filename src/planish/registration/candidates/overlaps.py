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
    places = np.column_stack([group[owner], np.floor(points / cell_mm)]).astype(np.int64)
    cell = np.unique(places, axis=0, return_inverse=True)[1].ravel()
    shape = len(footprints), int(cell.max()) + 1
    points_in = csr_array((np.ones(len(owner)), (owner, cell)), shape)
    points_in.sum_duplicates()
    cells = np.diff(points_in.indptr)
    mean = [csr_array((normals[:, k].astype(float), (owner, cell)), shape) for k in range(3)]
    for part in mean:
        part.sum_duplicates()
        part.data /= points_in.data
    common = sum((part @ part.T for part in mean[1:]), mean[0] @ mean[0].T).tocoo()
    own = np.flatnonzero(common.row < common.col)
    own = own[np.lexsort((common.col[own], common.row[own]))]
    a, b = common.row[own].astype(np.int64), common.col[own].astype(np.int64)
    return Overlaps(a, b, np.asarray(common.data[own] / np.minimum(cells[a], cells[b]), float))
