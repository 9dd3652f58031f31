"""Plane residual of a real flat board seen by one camera and a projector, Gray code alone (procam_board).

    python benchmarks/board.py

Distances from the best plane, in units of the calibration (a square of the board measures 75). Cell centres are what a
plain decoder has.
"""

from __future__ import annotations

import sys

import numpy as np

from planish.pipeline import measure
from render_tables import ROOT, save_table

sys.path.extend([str(ROOT / "tests"), str(ROOT / "tests" / "real")])
from captures import load
from test_board import board, cell_centres, fit_plane

from spread import robust_spread


def main() -> None:
    rows = []
    for index in range(3):
        capture = load("procam_board", f"capture_{index}.json")
        mask, _ = board(capture)
        centres = cell_centres(capture, mask)
        *_, distance, inliers = fit_plane(centres.points_sensor[np.isfinite(centres.sigma_mm)].astype(float))
        item = measure(capture)
        use = mask & item.valid
        _, normal, edges, near = fit_plane(item.points_sensor[use].astype(float))
        ray = item.points_sensor[use] / np.linalg.norm(item.points_sensor[use], axis=1, keepdims=True)
        rows.append({
            "what": f"capture {index}",
            "points": int(use.sum()),
            "share": float(use.sum() / mask.sum()),
            "plain": float(np.std(distance[inliers])),
            "edges": float(np.std(edges[near])),
            "robust": float(robust_spread(edges)),
            "predicted": float(np.median(item.sigma_mm[use] * np.abs(ray @ normal))),
        })  # fmt: skip
        print(rows[-1])
    columns = {
        "what": "position of the board",
        "points": "points",
        "share": "of its lit pixels",
        "plain": "cell centres, rms",
        "edges": "edges between the pixels, rms",
        "robust": "the same, robust sigma",
        "predicted": "noise alone, predicted",
    }
    units = dict.fromkeys(("plain", "edges", "robust", "predicted"), ".2f")
    save_table("board", columns, rows, "python benchmarks/board.py", {"points": ",d", "share": ".1%", **units})


if __name__ == "__main__":
    main()
