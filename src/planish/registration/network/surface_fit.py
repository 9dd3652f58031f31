"""A surface of the part (CAD or a reference cloud) as fixed frame: point to plane, as far as the surface holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from planish.geometry import Array, perturb, transform_points
from planish.registration.network.relations import GIVEN_FRAME, Relation
from planish.registration.refine.residuals import TUKEY

#: Points whose nearest surface point lies farther off beside them than this many pitches look past the surface's rim.
_BESIDE_PITCHES = 1.5
#: Neighbouring points share the surface's deviation from the part: points of one tile of this size count as one [mm].
_TILE_MM = 10.0
#: Directions whose standard deviation at the measurement's rim is more than this are held by nothing [mm].
_HELD_MM = 2.0
#: Least number of tiles that make a statement.
_LEAST_TILES = 12


@dataclass(frozen=True)
class FixedSurface:
    """Points (N, 3) of a surface with their unit normals (N, 3), about `pitch_mm` apart, in the given frame [mm]."""

    points: Array
    normals: Array
    pitch_mm: float

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the points."""
        return cKDTree(self.points)


def sample_mesh(vertices: Array, faces: NDArray[np.int64], most_points: int = 200_000) -> FixedSurface:
    """Return points of a mesh (V, 3), (F, 3) at the centres of equal parts of its triangles."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    keep = area > 0
    corners, normals, area = corners[keep], cross[keep] / area[keep, None], area[keep] / 2
    pitch = float(np.sqrt(2 * area.sum() / most_points))
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    parts = np.maximum(1, np.ceil(edges / (2 * pitch))).astype(int)
    points, directions = [], []
    for count in np.unique(parts):
        chosen = parts == count
        lattice = _lattice(int(count))
        points.append(np.einsum("lk,fki->fli", lattice, corners[chosen]).reshape(-1, 3))
        directions.append(np.repeat(normals[chosen], len(lattice), axis=0))
    # Parts are up to two pitches long: that is what lies between neighbours.
    return FixedSurface(np.concatenate(points), np.concatenate(directions), 2 * pitch)


def _lattice(count: int) -> Array:
    """Barycentric coordinates (count^2, 3) of the centres of the count^2 equal parts of a triangle."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(count) for j in range(count - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(count) for j in range(count - i - 1)]
    at = np.array(up + down) / count
    return np.column_stack([at, 1 - at.sum(1)])


def sample_cloud(points: Array, neighbours: int = 12) -> FixedSurface:
    """Return a cloud (N, 3) with normals by the plane through each point's neighbours."""
    tree = cKDTree(points)
    distance, near = tree.query(points, k=neighbours)
    around = points[near] - points[near].mean(1, keepdims=True)
    normals = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)[1][:, :, 0]
    return FixedSurface(points, normals, float(np.median(distance[:, -1])))


@dataclass(frozen=True)
class SurfaceHold:
    """Information (6, 6) of T_given_measurement about `point` by the surface, and its radius [mm]."""

    information: Array
    gradient: Array
    point: Array
    radius_mm: float


def surface_hold(surface: FixedSurface, points: Array, T_given: Array) -> SurfaceHold | None:
    """Return what the surface says of points (N, 3) of a measurement at T_given_measurement; None where few lie on it.

    Point-to-plane distances (Chen and Medioni 1992) with Tukey's weights at their own robust spread.
    """
    here = transform_points(T_given, points)
    _, nearest = surface.tree.query(here)
    apart, normals = surface.points[nearest] - here, surface.normals[nearest]
    distance = np.sum(normals * apart, 1)
    beside = np.linalg.norm(apart - distance[:, None] * normals, axis=1)
    on = beside < _BESIDE_PITCHES * surface.pitch_mm
    if not on.any():
        return None
    here, normals, distance = here[on], normals[on], distance[on]
    tiles, tile, counts = np.unique(
        np.floor(here / _TILE_MM).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    if len(tiles) < _LEAST_TILES:
        return None
    spread = max(1.4826 * float(np.median(np.abs(distance))), _FLOOR_MM)
    weights = np.clip(1 - (distance / (TUKEY * spread)) ** 2, 0, None) ** 2 / counts[tile.ravel()] / spread**2
    point = here.mean(0)
    J = np.column_stack([np.cross(here - point, normals), normals])
    radius = float(np.sqrt(np.mean(np.sum((here - point) ** 2, 1))))
    return SurfaceHold((J * weights[:, None]).T @ J, J.T @ (weights * distance), point, radius)


#: Exact points on an exact surface have no spread; information must stay finite [mm].
_FLOOR_MM = 1e-4


def held_directions(hold: SurfaceHold) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return information along eigenvectors (6,), these (6, 6) as columns [radius rad, mm], and which are held."""
    arm = np.array([1 / hold.radius_mm] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(hold.information * np.outer(arm, arm))
    return values, vectors, values > 1 / _HELD_MM**2


def surface_relation(hold: SurfaceHold, name: str, T_given: Array) -> Relation:
    """Return what a surface says of one measurement in the directions that it holds."""
    values, vectors, held = held_directions(hold)
    arm = np.array([1 / hold.radius_mm] * 3 + [1.0] * 3)
    V, size = vectors[:, np.flatnonzero(held)], np.sqrt(values[held])
    xi = arm * (V @ ((V.T @ (arm * hold.gradient)) / values[held]))
    root = np.zeros((6, 6))
    root[: len(size)] = size[:, None] * (V / arm[:, None]).T
    T = perturb(T_given, xi, hold.point)
    return Relation("surface", GIVEN_FRAME, name, "", T, hold.point, root, dof=len(size))


def group_hold(holds: Mapping[str, SurfaceHold]) -> SurfaceHold:
    """Return what the surface says of all measurements of a group together, were they one."""
    points = np.array([hold.point for hold in holds.values()])
    centre = points.mean(0)
    information = np.zeros((6, 6))
    for hold in holds.values():
        carry = np.eye(6)
        # A motion about the common centre, seen about the measurement's own point.
        d = hold.point - centre
        carry[3:, :3] = -np.array([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
        information += carry.T @ hold.information @ carry
    radii = np.array([hold.radius_mm for hold in holds.values()])
    radius = float(np.sqrt(np.mean(np.sum((points - centre) ** 2, 1) + radii**2)))
    return SurfaceHold(information, np.zeros(6), centre, radius)
