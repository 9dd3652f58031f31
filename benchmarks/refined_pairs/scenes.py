"""Efficiency and convergence of the refinement, scene by scene: independent pairs with 40 to 60 % overlap, exact rig.

The least possible errors come from the simulation (`refined_pairs/bound.py`). From the outset: the transform that the
whole registration finds counts as the solution; another start has converged if it leads there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from coarse_pairs.parts import measure_part
from planish.geometry import difference, transform_points
from refined_pairs.bound import errors_mm, pair_bound
from refined_pairs.pairs import KINDS, draw_pair
from refined_pairs.run import KnownPair, known_pairs, moved
from refined_pairs.true_view import true_view
from shared.cells import Rows

#: Starts: shift [mm] and turn [deg] about the overlap's centroid, for strong grain and for less.
START, NEAR_START, STRONG_GRAIN = (3.0, 0.5), (1.0, 0.5), 0.01
#: A start has converged if it puts the overlap no farther from the solution than this [mm].
SAME_MM = 0.02
#: Points of the overlap at which the bound's errors are evaluated.
POINTS = 5000


def run_pair(kind: str, number: int, starts: int) -> Rows:
    """Return the record of one pair: its errors, the least possible ones, and where its starts lead."""
    part, case = draw_pair(kind, number)
    measured = measure_part(part)
    row: dict[str, Any] = {"study": "scenes", "kind": kind, "number": number}
    known = known_pairs(part, [case], measured)
    if not known:
        return [row | {"status": "not measured"}]
    pair = known[case]
    result = pair.register()
    row |= {"overlap": round(pair.overlap[0], 4), "status": result.status, "reason": result.reason}
    if result.T_a_b is None:
        return [row]
    row["along_mm"], row["normal_mm"] = pair.errors_mm(result.T_a_b)
    scene = part.scene()
    views = [true_view(scene, i, measured[i].valid) for i in (case.first, case.second)]
    bound = pair_bound(*views, pair.T_a_b, pair.centre)
    surface = _surface_a(pair)
    row["bound_along_mm"], row["bound_normal_mm"] = errors_mm(bound.covariance, *surface, pair.centre)
    if result.covariance_noise is not None and result.covariance_point_mm is not None:
        stated = errors_mm(result.covariance_noise, *surface, result.covariance_point_mm)
        row["stated_along_mm"], row["stated_normal_mm"] = stated
    xi = difference(pair.T_a_b, result.T_a_b, pair.centre)
    row["squares_over_bound"] = float(xi @ bound.information @ xi)
    return [row | _converged(pair, kind, number, result.T_a_b, starts)]


def _surface_a(pair: KnownPair) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals (N, 3) of b's surface in the true overlap, in frame a."""
    normals = pair.sides[1].surface.normals_sensor[pair.overlap[1]].astype(float)
    known = np.flatnonzero(np.isfinite(normals[:, 2]))
    known = known[:: max(1, len(known) // POINTS)]
    return np.asarray(transform_points(pair.T_a_b, pair.points_b[known])), normals[known] @ pair.T_a_b[:3, :3].T


def _converged(pair: KnownPair, kind: str, number: int, solution: np.ndarray, starts: int) -> dict[str, Any]:
    shift_mm, turn_deg = START if KINDS[kind].grain >= STRONG_GRAIN else NEAR_START
    rng = np.random.default_rng([number, 17])
    apart = []
    for _ in range(starts):
        T = pair.refine(moved(pair.T_a_b, pair.centre, rng, shift_mm, turn_deg))
        apart.append(np.inf if T is None else pair.distance_mm(T, solution))
    # Which of them failed is worth knowing: they can be drawn again from the number.
    failed = [i for i, d in enumerate(apart) if not d <= SAME_MM]
    return {"shift_mm": shift_mm, "turn_deg": turn_deg, "starts": starts, "failed": failed,
            "failed_mm": [None if np.isinf(apart[i]) else round(apart[i], 4) for i in failed]}  # fmt: skip
