"""Does the refinement know when it ended beside the solution? Wrong optima of its own making, and what notices them.

From random starts some millimetres off along the surface, on the finest level alone: its slopes lead to the nearest
optimum of the texture, right or wrong. Each end is judged as the registration would judge it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from coarse_pairs.parts import measure_part
from planish.geometry import Array, perturb
from planish.registration.pair import kept_out_agreement, refine_pair, residual_statistics
from planish.registration.refine.covariance import noise_covariance
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.geometry import Sight
from planish.registration.verdict.hypothesis import Drift, Hypothesis, as_hypothesis
from planish.registration.verdict.judge import judge_refined
from refined_pairs.pairs import draw_pair
from refined_pairs.run import KnownPair, known_pairs
from shared.cells import Rows

#: Starts: shifts [mm], each in several random directions along the surface.
SHIFTS_MM, DIRECTIONS = (1.0, 2.0, 3.0, 4.0, 6.0), 2
#: Less than this from the truth is no other optimum, in pixels.
BESIDE_PX = 0.25
CLEAR = Sight(meet=1, hidden=0)


def run_pair(kind: str, number: int, scale: float) -> Rows:
    """Return one record per end: how far off it is, and which of the witnesses refuse it."""
    part, case = draw_pair(kind, number, scale)
    known = known_pairs(part, [case], measure_part(part))
    if not known:
        return []
    pair = known[case]
    windows = as_hypothesis(*(Side(p.measurement, p.images, p.contrast) for p in (pair.a, pair.b)), pair.T_a_b,
                            pair.options.verdict.verify)  # fmt: skip
    rng = np.random.default_rng([number, 23])
    head = {"study": "failures", "kind": kind, "number": number, "scale": scale}
    rows = [head | _judged(pair, pair.T_a_b, windows, pair.options.refine.spacing_px)]
    for shift_mm in SHIFTS_MM:
        for _ in range(DIRECTIONS):
            start = _moved_along(pair, rng, shift_mm)
            rows.append(head | _judged(pair, start, windows, pair.options.refine.spacing_px[-1:]))
    return rows


def _moved_along(pair: KnownPair, rng: np.random.Generator, shift_mm: float) -> Array:
    normals = pair.sides[1].surface.normals_sensor[pair.overlap[1]].astype(float) @ pair.T_a_b[:3, :3].T
    normal = np.nanmean(normals, 0)
    along = np.cross(normal, rng.standard_normal(3))
    return perturb(pair.T_a_b, np.concatenate([np.zeros(3), shift_mm * along / np.linalg.norm(along)]), pair.centre)


def _judged(pair: KnownPair, start: Array, windows: Hypothesis, spacing_px: tuple[int, ...]) -> dict[str, Any]:
    levels = {"spacing_px": spacing_px, "max_distance_mm": pair.options.refine.max_distance_mm[-len(spacing_px) :]}
    options = pair.options.model_copy(update={"refine": pair.options.refine.model_copy(update=levels)})
    found = refine_pair(pair.a, pair.b, start, options, 1)
    if found is None:
        return {"off_mm": None}
    verdict, none = pair.options.verdict, Drift(0.0)
    kept_out = kept_out_agreement(pair.a, pair.b, found, noise_covariance(found), options, 1)
    fit = residual_statistics(pair.a, pair.b, found, pair.options, 1)
    drift = windows.drift(found.T_a_b, pair.a.images[0].pitch_mm)
    off_mm = pair.distance_mm(found.T_a_b, pair.T_a_b)
    return {
        "off_mm": off_mm,
        "beside": bool(off_mm > BESIDE_PX * pair.b.measurement.sample_distance_mm),
        "by_kept_out": judge_refined(found, (), none, CLEAR, verdict, None, kept_out) is not None,
        "by_residuals": judge_refined(found, (), none, CLEAR, verdict, fit=fit) is not None,
        "by_drift": judge_refined(found, (), drift, CLEAR, verdict) is not None,
        "common_texture": fit.common_texture,
    }
