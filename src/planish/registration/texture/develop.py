"""Unrolling a piece of surface into the plane: lengths and angles stay wherever the surface is developable.

Sheet metal is nearly so. Two captures of it then give pictures that differ by a turn and a shift, whatever the
curvature and the direction they were taken from. A surface of double curvature is stretched as little as least squares
can.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse.csgraph import connected_components

from planish.geometry import Array
from planish.registration.surface import Surface

#: Neighbouring nodes whose normals differ by more than this do not hang together [cosine; 60 degrees].
_MIN_COSINE = 0.5
#: Nor do those whose connection leaves both their tangent planes by more than this [sine]: a jump in depth.
_MAX_LIFT = 0.5


@dataclass(frozen=True)
class Nodes:
    """Every n-th pixel of a measurement's surface, and which neighbours hang together.

    Parameters
    ----------
    step_px : int
        Distance of the nodes along rows and columns; node (0, 0) is pixel (step_px // 2, step_px // 2).
    shape : tuple of int
        Rows and columns of nodes.
    index : ndarray (N,) int64
        Place of each known node in the flattened grid.
    points, normals : ndarray (N, 3)
        Position [mm] and unit normal in the sensor frame.
    edges : ndarray (E, 2) int64
        Neighbours along rows, columns and diagonals.
    """

    step_px: int
    shape: tuple[int, int]
    index: NDArray[np.int64]
    points: Array
    normals: Array
    edges: NDArray[np.int64]

    def take(self, nodes: NDArray[np.int64]) -> Nodes:
        """Return a part of the nodes, with the edges among them."""
        new = np.full(len(self.index), -1)
        new[nodes] = np.arange(len(nodes))
        edges = new[self.edges]
        return Nodes(
            self.step_px, self.shape, self.index[nodes], self.points[nodes], self.normals[nodes],
            edges[(edges >= 0).all(1)],
        )  # fmt: skip

    def pieces(self, smallest: int) -> list[Nodes]:
        """Return the parts that hang together and have at least `smallest` nodes, the largest first."""
        n = len(self.index)
        graph = sparse.coo_matrix((np.ones(len(self.edges)), tuple(self.edges.T)), shape=(n, n))
        _, label = connected_components(graph, directed=False)
        sizes = np.bincount(label, minlength=0)
        order = np.argsort(-sizes, kind="stable")
        return [self.take(np.flatnonzero(label == k)) for k in order if sizes[k] >= smallest]


def surface_nodes(surface: Surface, step_px: int) -> Nodes:
    """Return the nodes of a surface, every `step_px` pixels."""
    first = step_px // 2
    grid = np.s_[first::step_px, first::step_px]
    points, normals = surface.points_sensor[grid].astype(float), surface.normals_sensor[grid].astype(float)
    rows, columns = points.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    ends = [
        (number[:, :-1], number[:, 1:]),
        (number[:-1], number[1:]),
        (number[:-1, :-1], number[1:, 1:]),
        (number[:-1, 1:], number[1:, :-1]),
    ]
    edges = np.concatenate([np.column_stack([i.ravel(), j.ravel()]) for i, j in ends])
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    index = np.flatnonzero(np.isfinite(points).all(1) & np.isfinite(normals).all(1))
    everything = Nodes(step_px, (rows, columns), np.arange(rows * columns), points, normals, edges)
    known = everything.take(index)
    i, j = known.edges.T
    d = known.points.take(j, 0) - known.points.take(i, 0)
    n_i, n_j = (known.normals.take(ends, 0) for ends in (i, j))
    lift = np.maximum(np.abs(_dot(n_i, d)), np.abs(_dot(n_j, d)))
    hangs = (_dot(n_i, n_j) > _MIN_COSINE) & (lift < _MAX_LIFT * np.linalg.norm(d, axis=1))
    return Nodes(step_px, known.shape, index, known.points, known.normals, known.edges[hangs])


def unroll(nodes: Nodes, x_hint: Array) -> tuple[Array, Array, Array]:
    """Return the plane coordinates of nodes that hang together, their axes and what the plane stretches.

    The axes are a field of tangents as parallel as the surface allows: where it is developable they are parallel
    (Levi-Civita), their projections of the surface's steps add up to zero around every loop, and the coordinates are
    exact. Both the turns of the axes and the coordinates are least squares over all edges, with the same matrix.

    Parameters
    ----------
    x_hint : ndarray (3,)
        Direction in the sensor frame that the x axis follows on average.

    Returns
    -------
    coordinates : ndarray (N, 2)
        x and y [mm]; seen from outside, x points right, y down.
    axes : ndarray (N, 2, 3)
        Unit tangents along x and y.
    strain : ndarray (E,)
        Relative change of length of each edge.
    """
    n, (i, j) = nodes.normals, nodes.edges.T
    mean = n.mean(0) / np.linalg.norm(n.mean(0))
    start = x_hint - (x_hint @ mean) * mean
    x = _transport(np.broadcast_to(start / np.linalg.norm(start), n.shape), np.broadcast_to(mean, n.shape), n)
    y = np.cross(x, n)
    carried = _transport(x.take(i, 0), n.take(i, 0), n.take(j, 0))
    turn = np.arctan2(_dot(carried, y.take(j, 0)), _dot(carried, x.take(j, 0)))
    solve = _sums_over_edges(nodes.edges, len(n))
    angle = solve(turn)
    angle -= np.median(angle)
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    axes = np.stack([cosine * x + sine * y, cosine * y - sine * x], 1)
    arcs, steps = _arcs(nodes)
    projected = 0.5 * np.einsum("eki,ei->ek", axes.take(i, 0) + axes.take(j, 0), steps)
    coordinates = np.stack([solve(projected[:, 0]), solve(projected[:, 1])], 1)
    length = np.linalg.norm(coordinates.take(j, 0) - coordinates.take(i, 0), axis=1)
    return coordinates, axes, length / np.linalg.norm(arcs, axis=1) - 1


def _arcs(nodes: Nodes) -> tuple[Array, Array]:
    """Return steps (E, 3) along the edges, of the length of their arcs, and those whose projections are that long.

    Where the normal turns by t from node to node, on a circle, the chord is sin(t / 2) / (t / 2) of the arc, and what
    the mean of the unit tangents sees of the chord is cos(t / 2) of that.
    """
    i, j = nodes.edges.T
    d, bend = (m.take(j, 0) - m.take(i, 0) for m in (nodes.points, nodes.normals))
    size = np.linalg.norm(bend, axis=1)
    turn = 2 * np.arcsin(np.minimum(size / 2, 1))
    across = bend / np.maximum(size, 1e-12)[:, None]
    chord = _dot(d, across)[:, None] * across
    arc, projectable = (1 / np.sinc(x / np.pi) - 1 for x in (turn / 2, turn))
    return d + arc[:, None] * chord, d + projectable[:, None] * chord


def _sums_over_edges(edges: NDArray[np.int64], count: int) -> Callable[[Array], Array]:
    """Return the function that finds values (N,) from their differences (E,) along the edges, the first being 0.

    Nodes are numbered along rows, the first of an edge before the second: the matrix of the normal equations is a band
    as wide as a row is long.
    """
    i, j = edges.T
    width = int((j - i).max(initial=0))
    # Lower form of LAPACK: row k holds the k-th diagonal below the main one.
    band = np.zeros((width + 1, count))
    band[0] = np.bincount(edges.ravel(), minlength=count)
    band[0, 0] += 1.0
    np.subtract.at(band, (j - i, i), 1.0)
    factors = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)

    def solve(values: Array) -> Array:
        right = np.bincount(edges[:, 1], values, count) - np.bincount(edges[:, 0], values, count)
        return np.asarray(cho_solve_banded((factors, True), right, check_finite=False))

    return solve


def _transport(v: Array, n: Array, to: Array) -> Array:
    """Turn tangents v (N, 3) by the shortest rotation of normals n onto `to`."""
    axis = _cross(n, to)
    turned = _cross(axis, v)
    return v + turned + _cross(axis, turned) / (1 + _dot(n, to))[:, None]


def _cross(a: Array, b: Array) -> Array:
    # By columns; np.cross takes several times as long for short vectors.
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a.T, b.T
    return np.stack([a_y * b_z - a_z * b_y, a_z * b_x - a_x * b_z, a_x * b_y - a_y * b_x], 1)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i->...", a, b)
