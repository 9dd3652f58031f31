"""Accuracy of the refinement over the pairs of the coarse registration's grid, at full resolution, exact rig."""

from __future__ import annotations

from typing import Any

from coarse_pairs.parts import describe_case, draw_part, measure_part
from refined_pairs.run import known_pairs
from shared.cells import Rows

#: Least overlap of a case.
OVERLAP = 0.3


def run_part(number: int) -> Rows:
    """Register all pairs of one part, each from its own coarse consensus, and return their errors."""
    part, cases = draw_part(number, 1.0)
    cases = [case for case in cases if case.planned_overlap >= OVERLAP]
    rows: Rows = []
    for case, pair in known_pairs(part, cases, measure_part(part) if cases else {}).items():
        overlap = pair.overlap[0]
        if overlap < OVERLAP:
            continue
        result = pair.register()
        row: dict[str, Any] = {
            "study": "accuracy", **describe_case(part, case), "overlap": round(overlap, 4), "status": result.status,
            "reason": result.reason,
        }  # fmt: skip
        for kind, T in (("coarse_", result.T_coarse_a_b), ("", result.T_a_b)):
            along, normal = (None, None) if T is None else pair.errors_mm(T)
            row |= {f"{kind}along_mm": along, f"{kind}normal_mm": normal}
        rows.append(row)
    return rows
