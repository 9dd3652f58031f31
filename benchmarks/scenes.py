"""Registration of all simulated surfaces against truth: five measurements each, reference sensor, default texture.

python benchmarks/scenes.py --seeds 1 2
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from planish.evaluation.prepared import Prepared
from planish.evaluation.truth import Truth, compare_with_truth
from planish.pipeline import measure, register_run
from planish.sensing.capture.manifest import Capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from render_tables import save_table

SCENES = ("door", "plate", "cylinder", "pipe", "waves")
#: Pairs that truly overlap by at least this much are expected to be found.
EXPECTED_OVERLAP = 0.30


def run_scene(name: str, seeds: list[int], captures: int) -> dict[str, float | int | str]:
    """Register one scene for every seed and return its row."""
    along, normal, nees, accepted, wrong, missing = [], [], [], 0, 0, 0
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            folders = write_scene(make_scene(name, seed, captures), Path(folder), true_points=False)
            measurements = [measure(Capture.load(f)) for f in folders]
            truth = Truth.load(Path(folder) / "truth.json")
        run = register_run(measurements)
        prepared = {n: Prepared(p.measurement, p.surface, p.contrast) for n, p in run.prepared.items()}
        evaluation = compare_with_truth(run.registration, truth, prepared)
        accepted += sum(p.status == "accepted" for p in run.registration.pairs)
        for pair in evaluation.pairs:
            if pair.tangential_rms_mm is None or pair.normal_rms_mm is None or pair.nees is None:
                continue
            wrong += pair.tangential_rms_mm > 1.0
            along.append(pair.tangential_rms_mm)
            normal.append(pair.normal_rms_mm)
            nees.append(pair.nees / 6)
        missing += sum("missing" in finding for finding in evaluation.findings)
    return {
        "scene": name, "seeds": len(seeds), "accepted": accepted, "wrong": wrong, "missing": missing,
        "along_median": float(np.median(along)), "along_worst": max(along),
        "normal_median": float(np.median(normal)), "normal_worst": max(normal), "nees": float(np.mean(nees)),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--captures", type=int, default=4)
    arguments = parser.parse_args()
    rows = []
    for name in SCENES:
        rows.append(run_scene(name, arguments.seeds, arguments.captures))
        print(rows[-1], flush=True)
    columns = {
        "scene": "surface", "seeds": "seeds", "accepted": "pairs accepted", "wrong": "of them wrong (> 1 mm)",
        "missing": f"refused though {EXPECTED_OVERLAP:.0%} overlap", "along_median": "along, median [mm]",
        "along_worst": "along, worst [mm]", "normal_median": "normal, median [mm]",
        "normal_worst": "normal, worst [mm]", "nees": "mean NEES / 6",
    }  # fmt: skip
    formats = dict.fromkeys(("along_median", "along_worst", "normal_median", "normal_worst"), ".4f") | {"nees": ".2f"}
    command = (
        f"python benchmarks/scenes.py --seeds {' '.join(map(str, arguments.seeds))} --captures {arguments.captures}"
    )
    save_table("scenes", columns, rows, command, formats)


if __name__ == "__main__":
    main()
