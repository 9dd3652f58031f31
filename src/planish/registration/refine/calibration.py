"""What errors of the calibration do to a refined transform: both measurements displaced by the same error of one rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array, transform_points, translation
from planish.measurement import Measurement
from planish.options import thread_count
from planish.registration.refine.residuals import Equations, JointSide, equations
from planish.registration.refine.solve import Refined, RefineOptions, held_directions
from planish.registration.rig_errors import displacements, rig_key, states_errors

#: Tiles of the overlap on which displacements count as even, and pixels of the overlap that stand for all.
TILES, SAMPLES = 300, 30000
#: Shift by which the gradient of the cost is differentiated, in robust standard deviations of the distances.
STEP = 0.2


@dataclass(frozen=True)
class ErrorSide:
    """One measurement as its rig's errors see it.

    Parameters
    ----------
    measurement : Measurement
        Its rig and what gave its points.
    side : JointSide
        The maps that the last level of the refinement compared.
    """

    measurement: Measurement
    side: JointSide


def calibration_covariance(shifts: Mapping[str, Array] | None) -> Array | None:
    """Return the sum of the outer products of the shifts (k, 6) of all rigs; None where there are none."""
    if shifts is None:
        return None
    return np.asarray(sum((xi.T @ xi for xi in shifts.values()), np.zeros((6, 6))))


def calibration_shifts(
    a: ErrorSide, b: ErrorSide, refined: Refined, options: RefineOptions | None = None, threads: int | None = None
) -> dict[str, Array] | None:
    """Return per rig (by its key) the changes xi (k, 6) of T_a_b by the modes of its covariance.

    None unless both measurements' rigs state their errors.

    Notes
    -----
    The refinement ends where the gradient g = J' W r of the cost vanishes. An error of the rig moves points of a by e_a
    and those of b by e_b, each with its texture: as far as residuals are concerned, points of b move by D = R e_b - e_a
    in the frame of a. Tile by tile, the change P of g by a displacement of its points is found by shifting b: it holds
    all that the refinement does, robust weights, look-up along a's rays, interpolation. A change xi of the transform is
    the displacement G xi of a rigid motion, so that xi = -(sum P G)^-1 sum P D. Directions that the refinement leaves
    out do not move.
    """
    if not (states_errors(a.measurement) and states_errors(b.measurement)):
        return None
    options = options or RefineOptions()
    pull = _pull(a, b, refined, options, thread_count(threads))
    V, _ = held_directions(refined.equations, refined.lever_mm, options.max_sigma_mm)
    H = np.einsum("nij,njk->ik", pull.by_shift, _rigid(pull.points - refined.about))
    solve = V @ np.linalg.solve(V.T @ H @ V, V.T)
    shifts: dict[str, Array] = {}
    pixels_a = np.rint(a.measurement.camera.project(pull.points)).astype(np.intp)
    for item, pixels, turn in ((a, pixels_a, np.eye(3)), (b, pull.pixels_b, -refined.T_a_b[:3, :3])):
        found = displacements(item.measurement, pixels)
        assert found is not None
        known = np.isfinite(found).all((0, 2))
        g = np.einsum("nij,jl,knl->ki", pull.by_shift[known], turn, found[:, known], optimize=True)
        key = rig_key(item.measurement.rig)
        shifts[key] = shifts.get(key, np.zeros(6)) + g @ solve.T
    return shifts


@dataclass(frozen=True)
class _Pull:
    """One pixel (u, v) of b and its point in a's frame (n, 3) per tile, and the change (n, 6, 3) of the gradient by it."""

    pixels_b: NDArray[np.intp]
    points: Array
    by_shift: Array


def _pull(a: ErrorSide, b: ErrorSide, refined: Refined, options: RefineOptions, threads: int) -> _Pull:
    points = refined.equations.points
    stride = max(1, round(float(np.sqrt(points / SAMPLES))))
    tile = max(1, round(float(np.sqrt(points / TILES)) / stride)) * stride

    def at(shift: Array, residuals: bool = False) -> Equations:
        return equations(
            a.side, b.side, translation(shift) @ refined.T_a_b, refined.about, refined.weights,
            max_distance_mm=options.max_distance_mm[-1], max_normal_rad=options.max_normal_rad,
            stride=stride, tile_px=tile, residuals=residuals, threads=threads,
        )  # fmt: skip

    here = at(np.zeros(3), True)
    step = STEP * refined.weights.scale_distance_mm
    by_shift = np.stack([at(step * axis).tile_gradients - here.tile_gradients for axis in np.eye(3)], -1) / step
    # One pixel per tile, the one nearest to its middle.
    v, u = np.nonzero(np.isfinite(here.distances))
    middle = np.hypot(v % tile - (tile - 1) / 2, u % tile - (tile - 1) / 2)
    order = np.argsort(middle, kind="stable")
    tiles = (v // tile) * by_shift.shape[1] + u // tile
    numbers, first = np.unique(tiles[order], return_index=True)
    chosen = order[first]
    pixels = np.stack([u, v], -1)[chosen]
    x = transform_points(refined.T_a_b, b.side.maps[0][v[chosen], u[chosen]].astype(float))
    return _Pull(pixels, np.asarray(x), by_shift.reshape(-1, 6, 3)[numbers])


def _rigid(lever: Array) -> Array:
    """Displacements (n, 3, 6) of points by xi."""
    out = np.zeros((len(lever), 3, 6))
    out[:, [0, 1, 2], [3, 4, 5]] = 1.0
    out[:, 0, 1], out[:, 0, 2] = lever[:, 2], -lever[:, 1]
    out[:, 1, 0], out[:, 1, 2] = -lever[:, 2], lever[:, 0]
    out[:, 2, 0], out[:, 2, 1] = lever[:, 1], -lever[:, 0]
    return out
