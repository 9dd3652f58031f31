"""The demo over several seeds: errors against truth per seed, saved for the README.

python benchmarks/demo.py --seeds 1 2 3 4 5
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from render_tables import save_table


def run_seed(seed: int) -> dict[str, float | int]:
    """Run `planish demo` in a process of its own and return its row."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        command = [sys.executable, "-c", "from planish.cli import main; main()"]
        subprocess.run([*command, "demo", "--out", folder, "--seed", str(seed)], check=True, capture_output=True)
        seconds = time.perf_counter() - started
        registration = json.loads((Path(folder) / "registration.json").read_text())
        evaluation = json.loads((Path(folder) / "evaluation.json").read_text())
    pairs = evaluation["pairs"]
    accepted = [p for p in registration["pairs"] if p["status"] == "accepted"]
    return {
        "seed": seed,
        "accepted": len(accepted),
        "overlap": max(p["overlap"] for p in pairs),
        "least_overlap": min(p["overlap"] for p in pairs),
        "along": max(p["tangential_rms_mm"] for p in pairs),
        "normal": max(p["normal_rms_mm"] for p in pairs),
        "place_along": max(m["tangential_rms_mm"] for m in evaluation["measurements"]),
        "place_normal": max(m["normal_rms_mm"] for m in evaluation["measurements"]),
        "nees": sum(p["nees"] for p in pairs) / len(pairs) / 6,
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    seeds = parser.parse_args().seeds
    rows = []
    for seed in seeds:
        rows.append(run_seed(seed))
        print(rows[-1], flush=True)
    columns = {
        "seed": "seed",
        "accepted": "pairs accepted",
        "least_overlap": "least overlap",
        "along": "worst pair, along [mm]",
        "normal": "worst pair, normal [mm]",
        "place_along": "worst measurement, along [mm]",
        "place_normal": "worst measurement, normal [mm]",
        "nees": "mean NEES / 6",
        "seconds": "whole demo [s]",
    }
    formats = {"least_overlap": ".0%", "nees": ".2f", "seconds": ".0f"}
    formats |= dict.fromkeys(("along", "normal", "place_along", "place_normal"), ".4f")
    save_table("demo", columns, rows, "python benchmarks/demo.py --seeds " + " ".join(map(str, seeds)), formats)


if __name__ == "__main__":
    main()
