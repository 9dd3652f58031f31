"""The refinement beside its peers, all from one start: the same clouds, the same threads.

The peers get the same points; coloured ICP gets planish's own compensated texture and, as an alternative, the plain
white image. planish refines from that start, too, without what its coarse registration knows.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from coarse_pairs.parts import measure_part, true_transform
from planish.geometry import Array, perturb
from planish.registration.prepared import Prepared
from planish.registration.tiles import ground_sample_distance
from refined_pairs.pairs import draw_pair
from refined_pairs.run import KnownPair, known_pair
from shared.cells import Rows

#: The start is this far from the truth over the overlap, root mean square [mm].
START_MM = 0.7
#: Threads of all.
THREADS = 2
#: Methods of `peers.py`.
PEERS = ("coloured ICP", "point-to-plane ICP", "GICP")
#: Times are the median of so many.
RUNS = 3
#: Share of the texture's values that the peers' grey scale spans.
SPAN = (1.0, 99.0)


def run_pair(kind: str, number: int, peers: str | None, methods: tuple[str, ...]) -> Rows:
    """Return one record per method and settings; `methods` are those of the peers."""
    part, case = draw_pair(kind, number)
    measured = measure_part(part)
    started = time.perf_counter()
    pair = known_pair((measured[case.first], measured[case.second]), true_transform(part, case))
    prepared_s = time.perf_counter() - started
    start = start_off(pair, np.random.default_rng([number, 19]), START_MM)
    seconds, T = timed(lambda: pair.refine(start, THREADS))
    head = {"study": "beside", "kind": kind, "number": number}
    along, normal = pair.errors_mm(start)
    rows: Rows = [head | {"method": "start", "along_mm": along, "normal_mm": normal}]
    row: dict[str, Any] = head | {"method": "planish", "seconds": seconds, "prepared_s": prepared_s}
    if T is not None:
        row["along_mm"], row["normal_mm"] = pair.errors_mm(T)
        # What is worth knowing of a pair apart from its refinement: the evaluation of the overlap.
        row["overlap_s"], _ = timed(lambda: pair.evaluate(T, THREADS))
    rows.append(row)
    for found in run_peers(pair, start, peers, methods) if peers else []:
        errors = dict(zip(("along_mm", "normal_mm"), pair.errors_mm(np.array(found.pop("T"))), strict=True))
        rows.append(head | found | errors)
    return rows


def start_off(pair: KnownPair, rng: np.random.Generator, rms_mm: float) -> Array:
    """Return the truth moved in a random direction of all six, by so much over the overlap (root mean square)."""
    xi = rng.standard_normal(6) / np.array([100.0] * 3 + [1.0] * 3)
    for _ in range(3):
        xi *= rms_mm / pair.distance_mm(perturb(pair.T_a_b, xi, pair.centre), pair.T_a_b)
    return perturb(pair.T_a_b, xi, pair.centre)


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return the median seconds of a call and what it returned."""
    seconds, found = [], None
    for _ in range(RUNS):
        started = time.perf_counter()
        found = function()
        seconds.append(time.perf_counter() - started)
    return median(seconds), found


def run_peers(pair: KnownPair, start: Array, python: str, methods: tuple[str, ...]) -> Rows:
    """Return what the peers say, with all their settings."""
    values: dict[str, Any] = {"start": start, "truth": pair.T_a_b, "gsd": ground_sample_distance(pair.a.measurement)}
    for name, side in (("a", pair.a), ("b", pair.b)):
        use = side.measurement.valid & np.isfinite(side.contrast[0])
        values[name] = side.measurement.points_sensor[use]
        values[f"contrast_{name}"], values[f"white_{name}"] = (_grey(v[use]) for v in _textures(side))
    script = Path(__file__).with_name("peers.py")
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / name) for name in ("pair.npz", "peers.json")]
        np.savez(files[0], **values)
        environment = os.environ | {"OMP_NUM_THREADS": str(THREADS)}
        subprocess.run([python, str(script), *files, str(THREADS), *methods], check=True, env=environment)
        return list(json.loads(Path(files[1]).read_text(encoding="utf-8")))


def _textures(side: Prepared) -> tuple[Array, Array]:
    white = side.measurement.views[side.measurement.organised_on].white
    assert white is not None
    return side.contrast[0], white


def _grey(values: Array) -> Array:
    low, high = np.nanpercentile(values, SPAN)
    return np.clip((values - low) / max(high - low, 1e-9), 0, 1)
