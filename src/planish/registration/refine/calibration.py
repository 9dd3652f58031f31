"""What errors of the calibration do to a refined transform: both measurements displaced by the same error of a rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, transform_points
from planish.measurement import Measurement
from planish.options import thread_count
from planish.registration.refine.information import held_directions, information
from planish.registration.refine.residuals import Pull, pull
from planish.registration.refine.sides import JointSide
from planish.registration.refine.solve import Refined, RefineOptions
from planish.registration.rig_errors import displacements, rig_key, states_errors

#: Tiles of the overlap on which displacements count as even, and pixels of the overlap that stand for all.
TILES, SAMPLES = 200, 30000


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
    in the frame of a. P is the change of g by a displacement of all points of a tile: it holds all that the refinement
    does, robust weights, look-up along a's rays, interpolation. A change xi of the transform is the displacement G xi
    of a rigid motion, so that xi = -(sum P G)^-1 sum P D. Directions that the refinement leaves out do not move.
    """
    if not (states_errors(a.measurement) and states_errors(b.measurement)):
        return None
    options = options or RefineOptions()
    found = _pull(a, b, refined, options, thread_count(threads))
    u, v = found.pixels.T
    x = np.asarray(transform_points(refined.T_a_b, b.side.values[v, u, :3].astype(float)))
    pixels_a = np.rint(a.measurement.camera.project(x)).astype(np.intp)
    moved_a, moved_b = displacements(a.measurement, pixels_a, x), displacements(b.measurement, found.pixels)
    assert moved_a is not None
    assert moved_b is not None
    use = np.isfinite(moved_a).all((0, 2)) & np.isfinite(moved_b).all((0, 2))
    info = information(refined.equations, refined.lever_mm)
    trust = info.trust * info.scale[:, None] / info.scale
    P = trust @ found.distance[use] + found.texture[use]
    V, _ = held_directions(info, options.max_sigma_mm)
    H = np.einsum("nij,njk->ik", P, _rigid(x[use] - refined.about))
    solve = V @ np.linalg.solve(V.T @ H @ V, V.T)
    R, shifts = refined.T_a_b[:3, :3], dict[str, Array]()
    for item, forces, moved in ((a, P, moved_a[:, use]), (b, -P @ R, moved_b[:, use])):
        xi = np.einsum("nij,knj->ki", forces, moved, optimize=True) @ solve.T
        key = rig_key(item.measurement.rig)
        shifts[key] = shifts[key] + xi if key in shifts else xi
    return shifts


def _pull(a: ErrorSide, b: ErrorSide, refined: Refined, options: RefineOptions, threads: int) -> Pull:
    points = refined.equations.points
    stride = max(1, round(float(np.sqrt(points / SAMPLES))))
    return pull(
        a.side, b.side, refined.T_a_b, refined.about, refined.weights, max_distance_mm=options.max_distance_mm[-1],
        max_normal_rad=options.max_normal_rad, stride=stride, tile_px=round(float(np.sqrt(points / TILES))),
        threads=threads,
    )  # fmt: skip


def _rigid(lever: Array) -> Array:
    """Displacements (n, 3, 6) of points by xi."""
    out = np.zeros((len(lever), 3, 6))
    out[:, [0, 1, 2], [3, 4, 5]] = 1.0
    out[:, 0, 1], out[:, 0, 2] = lever[:, 2], -lever[:, 1]
    out[:, 1, 0], out[:, 1, 2] = -lever[:, 2], lever[:, 0]
    out[:, 2, 0], out[:, 2, 1] = lever[:, 1], -lever[:, 0]
    return out
