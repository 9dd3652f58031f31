"""Plane residual of a real flat board seen by one camera and a projector, Gray code alone (procam_board).

    python benchmarks/board.py

Distances from the best plane, in units of the calibration (a square of the board measures 75). Cell centres are what a
plain decoder has. The calibration is the author's; then that of planish by the corners and the code of the same boards.
"""

from __future__ import annotations

import sys

import numpy as np

from planish.measurement import Measurement
from planish.pipeline import CalibrateOptions, calibrate, measure
from render_tables import ROOT, save_table

sys.path.extend([str(ROOT / "tests"), str(ROOT / "tests" / "real")])
from captures import HERE, load
from test_board import board, cell_centres, fit_plane

from spread import robust_spread


def flatness_mm(item: Measurement, mask: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Distances of the board's points from their plane: rms without outliers, robust sigma; and the plane's normal."""
    _, normal, distance, near = fit_plane(item.points_sensor[mask & item.valid].astype(float))
    return float(np.std(distance[near])), float(robust_spread(distance)), normal


def main() -> None:
    rows = []
    images = load("procam_board", "capture_0.json").images_dir
    runs = HERE / "procam_board" / "boards.json"
    calibrated = calibrate(runs, CalibrateOptions(flatness=True), images_dir=images).rig
    for index in range(3):
        capture = load("procam_board", f"capture_{index}.json")
        mask, _ = board(capture)
        centres = cell_centres(capture, mask)
        *_, distance, inliers = fit_plane(centres.points_sensor[np.isfinite(centres.sigma_mm)].astype(float))
        item = measure(capture)
        use = mask & item.valid
        edges, robust, normal = flatness_mm(item, mask)
        own, own_robust, _ = flatness_mm(measure(capture, rig=calibrated), mask)
        ray = item.points_sensor[use] / np.linalg.norm(item.points_sensor[use], axis=1, keepdims=True)
        rows.append({
            "what": f"capture {index}",
            "points": int(use.sum()),
            "share": float(use.sum() / mask.sum()),
            "plain": float(np.std(distance[inliers])),
            "edges": edges,
            "robust": robust,
            "own": own,
            "own_robust": own_robust,
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
        "own": "the same by planish's calibration, rms",
        "own_robust": "robust sigma",
        "predicted": "noise alone, predicted",
    }
    units = dict.fromkeys(("plain", "edges", "robust", "own", "own_robust", "predicted"), ".2f")
    save_table("board", columns, rows, "python benchmarks/board.py", {"points": ",d", "share": ".1%", **units})


if __name__ == "__main__":
    main()
