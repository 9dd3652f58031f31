"""Coarse registration over thousands of drawn pairs: resumable, one JSON file per cell of 20 pairs.

    python benchmarks/coarse.py --pairs 2000
    python benchmarks/coarse.py --pairs 2000 --peers /path/to/python    (an environment with the peers, see below)

A pair succeeds where the root mean square error over the true overlap is at most 1 mm before refinement. The peers'
environment needs `open3d`, `kiss-matcher`, numpy; plain SIFT, ratio test and 3-point RANSAC on the white image runs
here.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from coarse_pairs import draw_case, make_pair, measure_pair, true_transform
from coarse_sift import register_plain_sift
from planish.errors import InputError
from planish.evaluation.prepared import Prepared as Evaluated
from planish.evaluation.truth import true_overlap
from planish.geometry import Array, transform_points
from planish.measurement import Measurement
from planish.options import thread_count
from planish.registration.pair import PairOptions, common_gsd, common_pitch, length_factor, prepare, register_pair
from render_tables import RESULTS, describe_machine

CELL = 20
#: A transform is right if it moves the overlap by less than this, root mean square [mm].
RIGHT_MM = 1.0
FOLDER = RESULTS / "coarse"


def run_pair(number: int, scale: float, peers: str | None) -> dict[str, Any]:
    """Return the record of one pair: the case, what planish says of it, what the peers say."""
    case = draw_case(number, scale)
    pair = make_pair(case)
    if pair is None:
        return {"case": case.to_json(), "skipped": "the part is too small for this overlap in this direction"}
    T = true_transform(pair[0])
    with tempfile.TemporaryDirectory() as folder:
        try:
            a, b = measure_pair(pair, Path(folder))
        except InputError as error:
            return {"case": case.to_json(), "skipped": None, "status": "not measured", "reason": str(error)}
        record: dict[str, Any] = {"case": case.to_json(), "skipped": None}
        record |= _planish(a, b, T)
        overlap_points = record.pop("_points")
        record["sift"] = error_mm(register_plain_sift(a, b), T, overlap_points)
        if peers:
            record |= _peers(a, b, T, overlap_points, peers, Path(folder))
    return record


def _planish(a: Measurement, b: Measurement, T: Array) -> dict[str, Any]:
    options = PairOptions().scaled(length_factor(common_gsd([a, b])))
    pitch = common_pitch([a, b])
    first, second = (prepare(m, pitch, options, 1) for m in (a, b))
    start = time.thread_time()
    result = register_pair(first, second, options, 1, 1)
    seconds = time.thread_time() - start
    overlap, inside = true_overlap(*(Evaluated(p.measurement, p.surface, p.contrast) for p in (first, second)), T, 1)
    points = b.points_sensor[inside].astype(float)
    points = points[:: max(1, len(points) // 2000)]
    return {
        "overlap": overlap,
        "status": result.status,
        "reason": result.reason,
        "matches": result.matches,
        "consensus": result.consensus,
        "log10_false_alarms": result.log10_false_alarms,
        "coarse_mm": error_mm(result.T_coarse_a_b, T, points),
        "refined_mm": error_mm(result.T_a_b, T, points),
        "pair_cpu_s": round(seconds, 3),
        "_points": points,
    }


def error_mm(T_hat: Array | None, T: Array, points_b: Array) -> float | None:
    """Return the error over the overlap's points (N, 3) [mm] as a root mean square; None without a transform."""
    if T_hat is None or len(points_b) == 0:
        return None
    d = transform_points(T_hat, points_b) - transform_points(T, points_b)
    return round(float(np.sqrt((d**2).sum(1).mean())), 5)


def _peers(a: Measurement, b: Measurement, T: Array, points: Array, python: str, folder: Path) -> dict[str, Any]:
    clouds = {name: m.points_sensor[m.valid] for name, m in (("a", a), ("b", b))}
    np.savez(folder / "pair.npz", **clouds)
    script = Path(__file__).with_name("coarse_peers.py")
    files = [str(folder / name) for name in ("pair.npz", "peers.json")]
    done = subprocess.run([python, str(script), *files], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return {"peers_failed": done.stderr[-500:]}
    found = json.loads(Path(files[1]).read_text(encoding="utf-8"))
    return {name: error_mm(np.array(item), T, points) for name, item in found.items()}


def run_cell(cell: int, scale: float, peers: str | None) -> Path:
    """Run the pairs of one cell and save them; a cell that is already there is kept."""
    path = FOLDER / f"{'half' if scale < 1 else 'full'}_{cell:04d}.json"
    if path.is_file():
        return path
    rows = [run_pair(number, scale, peers) for number in range(cell * CELL, (cell + 1) * CELL)]
    FOLDER.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.part")
    temporary.write_text(json.dumps({"machine": describe_machine(), "rows": rows}, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)
    return path


def records() -> Iterator[dict[str, Any]]:
    """Yield the records of all cells that are there."""
    for path in sorted(FOLDER.glob("*_*.json")):
        yield from json.loads(path.read_text(encoding="utf-8"))["rows"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=2000)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--peers", help="python of the peers' environment")
    parser.add_argument("--workers", type=int, default=thread_count())
    arguments = parser.parse_args()
    os.environ["PLANISH_THREADS"] = "1"
    with ProcessPoolExecutor(arguments.workers) as pool:
        cells = range(-(-arguments.pairs // CELL))
        for path in pool.map(run_cell, cells, [arguments.scale] * len(cells), [arguments.peers] * len(cells)):
            print(path, flush=True)


if __name__ == "__main__":
    main()
