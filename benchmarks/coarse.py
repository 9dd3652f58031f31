"""Coarse registration over thousands of drawn pairs, six captures per part: resumable, one JSON file per part.

    python benchmarks/coarse.py --pairs 2000                  (at half resolution)
    python benchmarks/coarse.py --pairs 200 --full
    python benchmarks/coarse.py --tables

A pair succeeds where it is accepted and the root mean square error over the true overlap is at most 1 mm before
refinement; an accepted transform that is further off after it is wrong. Plain SIFT with ratio test and 3-point RANSAC
on the white images runs beside. With `--peers PYTHON`, an environment with `open3d` and `kiss-matcher`, every
`--peer-every`-th pair goes through Open3D's FPFH + RANSAC and Fast Global Registration and KISS-Matcher, too.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coarse_pairs.parts import Case, Part, describe_case, draw_part, measure_part, true_transform
from coarse_pairs.sift import register_plain_sift, sift_keypoints
from coarse_pairs.tables import FOLDER, save_tables
from planish.evaluation.prepared import Prepared as Evaluated
from planish.evaluation.truth import true_overlap
from planish.geometry import Array, transform_points
from planish.measurement import Measurement
from planish.pipeline import prepare_run
from planish.registration.pair import register_pair
from shared.cells import Rows, cell_arguments, run_cells
from shared.environment import check_environment

#: Pairs per part on average: what the plan gives.
PAIRS_PER_PART = 14
#: Parts at full resolution have numbers of their own.
FIRST_FULL = 5000
#: Points of the overlap at which errors are evaluated.
ERROR_POINTS = 2000


def run_part(number: int, scale: float, peers: str | None, peer_every: int) -> Rows:
    """Return the records of all pairs of one part: the case, what planish says of it, what the peers say."""
    part, cases = draw_part(number, scale)
    measured = measure_part(part)
    rows: Rows = []
    known = []
    for case in cases:
        rows.append(describe_case(part, case))
        if {case.first, case.second} <= set(measured):
            known.append((case, rows[-1]))
        else:
            rows[-1]["status"] = "not measured"
    overlaps = register_cases(part, known, measured)
    _plain_sift(part, known, measured, overlaps)
    asked = [(case, row) for case, row in known if peers and (number + rows.index(row)) % peer_every == 0]
    for case, row in asked:
        row |= _peers(measured[case.first], measured[case.second], true_transform(part, case), overlaps[case], peers)
    return rows


def register_cases(
    part: Part, known: list[tuple[Case, dict[str, Any]]], measured: Mapping[int, Measurement]
) -> dict[Case, Array]:
    """Add to each case's record what planish says; return points (N, 3) of b in each case's true overlap."""
    options, prepared = prepare_run(list(measured.values()), threads=1)
    sides = {name: Evaluated(p.measurement, p.surface, p.contrast) for name, p in prepared.items()}
    pairs_in_run = max(1, len(measured) * (len(measured) - 1) // 2)
    overlaps = {}
    for case, row in known:
        a, b = measured[case.first].name, measured[case.second].name
        T = true_transform(part, case)
        started = time.thread_time()
        result = register_pair(prepared[a], prepared[b], options, pairs_in_run, 1)
        seconds = time.thread_time() - started
        overlap, inside = true_overlap(sides[a], sides[b], T, 1)
        points = measured[case.second].points_sensor[inside].astype(float)
        overlaps[case] = points[:: max(1, len(points) // ERROR_POINTS)]
        row |= {
            "overlap": round(overlap, 4),
            "status": result.status,
            "reason": result.reason,
            "matches": result.matches,
            "consensus": result.consensus,
            # Of the pair alone, without the correction for the number of pairs of the run.
            "log10_false_alarms": round(result.log10_false_alarms - float(np.log10(pairs_in_run)), 2),
            "coarse_mm": error_mm(result.T_coarse_a_b, T, overlaps[case]),
            "refined_mm": error_mm(result.T_a_b, T, overlaps[case]),
            "pair_cpu_s": round(seconds, 3),
        }
    return overlaps


def error_mm(T_hat: Array | None, T: Array, points_b: Array) -> float | None:
    """Return the error over the overlap's points (N, 3) [mm] as a root mean square; None without a transform."""
    if T_hat is None or len(points_b) == 0:
        return None
    d = transform_points(T_hat, points_b) - transform_points(T, points_b)
    return round(float(np.sqrt((d**2).sum(1).mean())), 5)


def _plain_sift(
    part: Part,
    known: list[tuple[Case, dict[str, Any]]],
    measured: Mapping[int, Measurement],
    overlaps: Mapping[Case, Array],
) -> None:
    keypoints = {index: sift_keypoints(m) for index, m in measured.items()}
    for case, row in known:
        T = register_plain_sift(keypoints[case.first], keypoints[case.second])
        row["sift_mm"] = error_mm(T, true_transform(part, case), overlaps[case])


def _peers(a: Measurement, b: Measurement, T: Array, points: Array, python: str) -> dict[str, Any]:
    clouds = {name: m.points_sensor[m.valid] for name, m in (("a", a), ("b", b))}
    script = Path(__file__).parent / "coarse_pairs" / "peers.py"
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / name) for name in ("pair.npz", "peers.json")]
        np.savez(files[0], **clouds)
        done = subprocess.run([python, str(script), *files], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            return {"peers_failed": done.stderr[-500:]}
        found = json.loads(Path(files[1]).read_text(encoding="utf-8"))
    return {f"{name}_mm": error_mm(np.array(item), T, points) for name, item in found.items()}


def main() -> None:
    parser = cell_arguments(__doc__)
    parser.add_argument("--pairs", type=int, default=2000)
    parser.add_argument("--full", action="store_true", help="full instead of half resolution")
    parser.add_argument("--peers", help="python of the peers' environment")
    parser.add_argument("--peer-every", type=int, default=40)
    arguments = parser.parse_args()
    if arguments.peers:
        check_environment(arguments.peers, "open3d", "kiss_matcher")
    if not arguments.tables:
        first, scale, kind = (FIRST_FULL, 1.0, "full") if arguments.full else (0, 0.5, "half")
        numbers = range(first, first + -(-arguments.pairs // PAIRS_PER_PART))
        cells = {f"{kind}_{n:04d}": (n, scale, arguments.peers, arguments.peer_every) for n in numbers}
        run_cells(FOLDER, cells, run_part, arguments.workers, arguments.again)
    save_tables()


if __name__ == "__main__":
    main()
