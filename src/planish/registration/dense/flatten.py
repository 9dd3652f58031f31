"""Flattening: coordinates on a surface in which lengths and angles are true, as far as its curvature allows.

A sheet that is bent without being stretched unrolls exactly, so that two measurements of it, seen from wherever, show
the same picture but for one rotation and one shift. What is curved twice cannot be unrolled; the map found here spreads
the inevitable strain ("as rigid as possible": Liu, Zhang, Xu, Gotsman, Gortler, Computer Graphics Forum 2008).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from planish.geometry import Array

#: Rounds at most; the strain of an unrolled cylinder of 120 degrees settles after some ten.
_ROUNDS = 30
#: Change of a place at which the map counts as settled [share of the mean edge].
_SETTLED = 1e-3


def flatten(points: Array, start: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return flat coordinates of a grid of points, one map per connected patch.

    Parameters
    ----------
    points : ndarray (h, w, 3)
        Points of the surface on a grid [mm]; NaN where there is none.
    start : ndarray (h, w, 2)
        First guess of the coordinates [mm], not folded over.

    Returns
    -------
    flat : ndarray (h, w, 2)
        Coordinates [mm]; NaN where there is no surface.
    patch : ndarray (h, w) intp
        Which patch a node belongs to, the largest first; -1 = none. Coordinates of different patches are unrelated.
    """
    h, w = points.shape[:2]
    triangles = _triangles(np.isfinite(points[..., 0]))
    flat, patch = np.full((h * w, 2), np.nan), np.full(h * w, -1, np.intp)
    if len(triangles) == 0:
        return flat.reshape(h, w, 2), patch.reshape(h, w)
    first, second = triangles[:, 0], triangles[:, 1:]
    graph = coo_matrix((np.ones(2 * len(first)), (np.repeat(first, 2), second.ravel())), shape=(h * w, h * w))
    _, label = connected_components(graph, directed=False)
    used = np.unique(triangles)
    names, counts = np.unique(label[used], return_counts=True)
    for number, name in enumerate(names[np.argsort(-counts, kind="stable")]):
        own = triangles[label[first] == name]
        nodes = np.unique(own)
        index = np.searchsorted(nodes, own)
        flat[nodes] = _as_rigid_as_possible(points.reshape(-1, 3)[nodes], start.reshape(-1, 2)[nodes], index)
        patch[nodes] = number
    return flat.reshape(h, w, 2), patch.reshape(h, w)


def _triangles(known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Node indices (n, 3) of all triangles: each cell of the grid is cut along both diagonals, for symmetry."""
    h, w = known.shape
    node = np.arange(h * w).reshape(h, w)
    a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]
    full = known[:-1, :-1] & known[:-1, 1:] & known[1:, 1:] & known[1:, :-1]
    corners = [(a, b, c), (a, c, d), (a, b, d), (b, c, d)]
    return np.concatenate([np.stack([x[full], y[full], z[full]], 1) for x, y, z in corners])


def _as_rigid_as_possible(points: Array, start: Array, triangles: NDArray[np.intp]) -> Array:
    """Flat coordinates (n, 2): each triangle's map from its own plane is held near a rotation."""
    gradient, area = _gradients(points, triangles)
    n, weighted = len(points), gradient * area[:, None, None]
    rows, columns = np.repeat(triangles, 3, axis=1).ravel(), np.tile(triangles, 3).ravel()
    stiffness = coo_matrix(
        (np.einsum("tin,tim->tnm", weighted, gradient).ravel(), (rows, columns)), shape=(n, n)
    ).tocsc()
    # The shift is free: the first node stays where it is.
    solver = splu(stiffness[1:, 1:])
    flat, edge = start.copy(), np.sqrt(area.mean())
    for _ in range(_ROUNDS):
        jacobian = np.einsum("tin,tnd->tdi", gradient, flat[triangles])
        angle = np.arctan2(jacobian[:, 1, 0] - jacobian[:, 0, 1], jacobian[:, 0, 0] + jacobian[:, 1, 1])
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], 1)  # [t, i, d], transposed
        force = np.zeros((n, 2))
        for d in range(2):
            parts = np.einsum("tin,ti->tn", weighted, rotation[:, :, d])
            force[:, d] = np.bincount(triangles.ravel(), parts.ravel(), n)
        moved = np.vstack([np.zeros(2), solver.solve(force[1:])])
        moved += flat.mean(0) - moved.mean(0)
        change = float(np.abs(moved - flat).max())
        flat = moved
        if change < _SETTLED * edge:
            break
    return flat


def _gradients(points: Array, triangles: NDArray[np.intp]) -> tuple[Array, Array]:
    """Gradients (t, 2, 3) of the corners' hat functions in each triangle's own plane [1/mm], and areas (t,) [mm^2]."""
    corner = points[triangles]
    u, v = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    length = np.linalg.norm(u, axis=1)
    along = np.einsum("ti,ti->t", u, v) / length
    across = np.linalg.norm(np.cross(u, v), axis=1) / length
    # In its plane the triangle is (0, 0), (length, 0), (along, across).
    zero = np.zeros_like(length)
    x = np.stack([-1 / length, 1 / length, zero], 1)
    y = np.stack([(along / length - 1) / across, -along / (length * across), 1 / across], 1)
    return np.stack([x, y], 1), 0.5 * length * across
