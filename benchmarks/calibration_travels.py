"""Whether the stated covariances hold for a rig with the errors of a calibration: pairs measured with drawn rigs.

    python benchmarks/calibration_travels.py --seeds 1 2 3 4 5 --draws 8

Each pair is rendered once with the true rig and measured with rigs drawn from the covariance of a calibration by 20
boards (0.05 px, pitch 1e-4), which they state as their own: what a user has whose calibration is right.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from planish.evaluation.truth import Truth, nees
from planish.geometry import difference
from planish.pipeline import measure, register
from planish.registration.result import PairResult
from planish.rig import Rig
from planish.sensing.capture.manifest import Capture
from planish.simulation.rigs import draw_rig
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from render_tables import ROOT, save_table

sys.path.append(str(ROOT / "tests"))
from calibrated_rig import with_calibration

SURFACES = ("plate", "door")
#: Half of the reference sensor's resolution: the same noise in coarser pixels.
SCALE = 0.5
#: Largest NEES of 95 of 100 transforms with a right covariance.
LIMIT_95 = float(chi2.ppf(0.95, 6))


def register_with(folders: Sequence[Path], rig: Rig) -> PairResult:
    """Measure two captures with a rig and register them."""
    for folder in folders:
        rig.save(folder / "rig.json")
    (pair,) = register([measure(Capture.load(folder)) for folder in folders]).pairs
    return pair


def whitened(pair: PairResult, truth: Truth) -> np.ndarray:
    """Error (6,) of a pair along the axes of its stated covariance, widest first, in standard deviations."""
    assert pair.T_a_b is not None
    xi = difference(truth.transform(pair.a, pair.b), pair.T_a_b, pair.covariance_point_mm)
    C = pair.covariance_noise + pair.covariance_calibration
    # Rotations count at 100 mm from the centre, about the rim of the overlap.
    scale = np.array([100.0] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(C * np.outer(scale, scale))
    return ((vectors.T @ (scale * xi)) / np.sqrt(values))[::-1]


def run_surface(name: str, seeds: Sequence[int], draws: int) -> dict[str, float | int | str]:
    """Measure and register one surface for every seed and drawn rig, and return its row."""
    exact, noise_alone, total, z = [], [], [], []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            folders = write_scene(make_scene(name, seed, 2, scale=SCALE), Path(folder), true_points=False)
            truth = Truth.load(Path(folder) / "truth.json")
            true_rig = Rig.load(folders[0] / "rig.json")
            rig = with_calibration(true_rig)
            for draw in range(-1, draws):
                pair = register_with(folders, true_rig if draw < 0 else draw_rig(rig, 1000 * seed + draw))
                if pair.T_a_b is None:
                    continue
                stated = pair.T_a_b, truth.transform(pair.a, pair.b), pair.covariance_point_mm, pair.covariance_noise
                (exact if draw < 0 else noise_alone).append(nees(*stated, None))
                if draw >= 0:
                    total.append(nees(*stated, pair.covariance_calibration))
                    z.append(whitened(pair, truth))
    squares = (np.array(z) ** 2).mean(0)
    print(name, "mean square per axis, widest first:", np.round(squares, 2))
    return {
        "surface": name, "pairs": len(seeds), "draws": len(total), "exact": float(np.mean(exact)) / 6,
        "noise": float(np.median(noise_alone)) / 6, "total": float(np.mean(total)) / 6,
        "coverage": float(np.mean(np.array(total) < LIMIT_95)), "wide": float(squares[:3].mean()),
        "narrow": float(squares[3:].mean()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--draws", type=int, default=8)
    arguments = parser.parse_args()
    rows = []
    for name in SURFACES:
        rows.append(run_surface(name, arguments.seeds, arguments.draws))
        print(rows[-1], flush=True)
    columns = {
        "surface": "surface", "pairs": "pairs", "draws": "registered with drawn rigs",
        "exact": "exact rig: mean NEES / 6", "noise": "drawn rigs, noise alone: median NEES / 6",
        "total": "noise and calibration: mean NEES / 6", "coverage": "within 95 %",
        "wide": "mean square, three widest axes", "narrow": "three narrowest axes",
    }  # fmt: skip
    formats = dict.fromkeys(("exact", "noise", "total", "coverage", "wide", "narrow"), ".2f")
    command = (
        f"python benchmarks/calibration_travels.py --seeds {' '.join(map(str, arguments.seeds))}"
        f" --draws {arguments.draws}"
    )
    save_table("calibration-travels", columns, rows, command, formats)


if __name__ == "__main__":
    main()
