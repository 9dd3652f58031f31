"""Growth of whole runs: measurements of one large panel, from files to registration.json, 50 to 1000 of them.

Captures of a fifth of the reference sensor's resolution (278 x 208 px, pixels of 1.6 mm), a grain that such pixels see
(8 mm x 4 mm, 3 %) and nothing else, at most 300 keypoints per measurement: times grow as they do at full resolution,
each is far less. Measurements overlap their neighbours by 35 %; those of a smaller run are a part of those of a larger
one. They are rendered and measured once and kept in a folder of temporary files; that is not timed. The run is
`register_files` in a process of its own, on one thread, whose memory is that of the run.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from networks.rendered import FIELD_MM, OVERLAP
from planish.execution.executor import Threads
from planish.geometry import Array, invert, transform_points
from planish.pipeline import register_files
from planish.pipeline.options import RegisterOptions
from planish.registration.result import Registration
from planish.simulation.scenes import Scene, make_scene, place_sensor
from planish.simulation.surfaces import Cylinder
from planish.simulation.texture import Grain, Texture
from render_tables import save_table
from shared.cells import Rows, machines, read_cells, run_cells
from shared.rendered import measure_scene

FOLDER = "network-whole"
#: Columns and rows of the parts of the panel by their number of measurements.
GRIDS = {50: (10, 5), 100: (10, 10), 200: (20, 10), 400: (20, 20), 1000: (40, 25)}
#: Resolution against the reference sensor's.
SCALE = 0.2
GRAIN = Texture(grain=Grain(0.03, 8.0, 4.0), scratches=None, specks=None, smudges=None)
OPTIONS = RegisterOptions.parse({"keypoints": {"max_keypoints": 300}}, "options")
#: A gently bent panel, 12.4 m along the bend and 6 m across.
PANEL = Cylinder(half_s=6200.0, half_t=3000.0, radius=20000.0)
#: A wrong transform, as against one that is off by a part of a pixel of 1.6 mm [mm].
WRONG_MM = 5.0

Place = tuple[int, int]
Pairs = set[tuple[str, str]]


def coarse_scene(part: str, surface: Cylinder, stands: Sequence[Array], seed: int = 1) -> Scene:
    """Return captures of a part with the grain and the sensor of these runs."""
    scene = replace(make_scene("cylinder", seed, 2, scale=SCALE), part=part, surface=surface, texture=GRAIN)
    # Two samples per pixel along both axes are 0.8 mm apart: a fifth of the grain.
    return replace(scene, sensor=replace(scene.sensor, samples_per_px=2)).seen_from(stands)


def stand(surface: Cylinder, s: float, t: float, rng: np.random.Generator) -> Array:
    """Return where a hand or robot holds the sensor that is to look at (s, t) [mm]."""
    return place_sensor(
        surface, s + rng.uniform(-8, 8), t + rng.uniform(-8, 8), rng.choice([0.0, 180.0]) + rng.uniform(-4, 4),
        (rng.uniform(-6, 6), rng.uniform(-6, 6)), rng.uniform(-15, 15),
    )  # fmt: skip


def panel() -> tuple[Scene, dict[Place, str]]:
    """Return the captures of the whole panel, and their names, which say nothing of the places."""
    columns, rows = GRIDS[1000]
    places = [(i, j) for i in range(columns) for j in range(rows)]
    rng = np.random.default_rng(7)
    step_s, step_t = ((1 - OVERLAP) * size for size in FIELD_MM)
    stands = [
        stand(PANEL, step_s * (i - (columns - 1) / 2), step_t * (j - (rows - 1) / 2), np.random.default_rng([7, i, j]))
        for i, j in places
    ]
    scene = coarse_scene("panel", PANEL, stands)
    names = [f"m{number:04d}" for number in rng.permutation(len(places))]
    return replace(scene, names=tuple(names)), dict(zip(places, names, strict=True))


def part_of(names: dict[Place, str], count: int) -> dict[Place, str]:
    """Return the places of a run of so many measurements."""
    columns, rows = GRIDS[count]
    return {place: name for place, name in names.items() if place[0] < columns and place[1] < rows}


def neighbours(names: dict[Place, str], steps: Sequence[Place]) -> Pairs:
    """Return the pairs of places that are these steps apart."""
    found = ((a, names.get((i + di, j + dj))) for (i, j), a in names.items() for di, dj in steps)
    return {(min(a, b), max(a, b)) for a, b in found if b is not None}


def make_measurements(scene: Scene, names: Sequence[str], folder: Path) -> list[Path]:
    """Render and measure those captures whose files are not there; return all files."""
    folder.mkdir(parents=True, exist_ok=True)
    index = {name: k for k, name in enumerate(scene.names)}
    for name in names:
        path = folder / f"{name}.h5"
        if not path.is_file():
            measure_scene(scene, index[name]).save(path)
    return [folder / f"{name}.h5" for name in names]


class Clock:
    """Processor time of a run by what it was spent on, told by its progress."""

    def __init__(self) -> None:
        self.seconds = {"measurements": 0.0, "pairs": 0.0, "rest": 0.0}
        self.first_round = 0
        self._last = ("", 0)
        self._then = time.process_time()

    def __call__(self, stage: str, done: int, total: int, reused: int) -> None:
        """Take the time since the last word: where a stage goes on it was spent on this stage."""
        now = time.process_time()
        goes_on = self._last[0] == stage and done > self._last[1]
        self.seconds[("pairs" if stage == "pairs" else "measurements") if goes_on else "rest"] += now - self._then
        if stage == "pairs" and not self.first_round:
            self.first_round = total
        self._last, self._then = (stage, done), now

    def stop(self) -> None:
        """Count what follows the last word as the rest."""
        self.seconds["rest"] += time.process_time() - self._then


def run_here(folder: Path, out: Path, names: Sequence[str]) -> dict[str, Any]:
    """Register files in this process; return what it took."""
    clock = Clock()
    with Threads(1) as executor:
        register_files([folder / f"{name}.h5" for name in names], out, OPTIONS, executor=executor, progress=clock)
    clock.stop()
    mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {**{f"{key}_s": value for key, value in clock.seconds.items()}, "first": clock.first_round, "mib": mib}


def run_apart(folder: Path, out: Path, names: Sequence[str]) -> dict[str, Any]:
    """Register files in a process of its own; return what it took."""
    own = {"PLANISH_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    command, environment = [sys.executable, "-m", __name__, str(folder), str(out)], {**os.environ, **own}
    done = subprocess.run(
        command, input="\n".join(names), env=environment, check=True, stdout=subprocess.PIPE, text=True
    )  # fmt: skip
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def wrong_pairs(scene: Scene, result: Registration) -> int:
    """Return how many accepted pairs in use put their overlap elsewhere."""
    true = dict(zip(scene.names, scene.T_object_sensor, strict=True))
    count = 0
    for pair in result.pairs:
        if pair.used and pair.T_a_b is not None and pair.covariance_point_mm is not None:
            T = invert(true[pair.a]) @ true[pair.b]
            there = transform_points(T @ invert(pair.T_a_b), pair.covariance_point_mm)
            count += bool(np.linalg.norm(there - pair.covariance_point_mm) > WRONG_MM)
    return count


def grow(count: int, cache: str) -> Rows:
    """Run so many measurements; the row says what was tried, found and spent."""
    scene, names = panel()
    chosen = part_of(names, count)
    files = make_measurements(scene, sorted(chosen.values()), Path(cache))
    with tempfile.TemporaryDirectory(dir=cache) as out:
        spent = run_apart(Path(cache), Path(out), [path.stem for path in files])
        result = Registration.load(Path(out) / "registration.json")
    tried = {(p.a, p.b) for p in result.pairs}
    used = {(p.a, p.b) for p in result.pairs if p.used}
    beside, corner = neighbours(chosen, [(1, 0), (0, 1)]), neighbours(chosen, [(1, 1), (1, -1)])
    seconds = sum(spent[f"{key}_s"] for key in ("measurements", "pairs", "rest"))
    return [
        {
            "measurements": count, "possible": count * (count - 1) // 2, "tried": len(tried),
            "tried_each": len(tried) / count, "beside_tried": 100 * len(beside & tried) / len(beside),
            "corner_tried": 100 * len(corner & tried) / len(corner),
            "beside_used": 100 * len(beside & used) / len(beside), "groups": len(result.groups),
            "placed": sum(m.group == 0 for m in result.measurements), "wrong": wrong_pairs(scene, result),
            "seconds": seconds, "each_s": seconds / count, **spent,
        }
    ]  # fmt: skip


COLUMNS = {
    "measurements": "measurements", "possible": "possible pairs", "first": "tried in the first round",
    "tried": "tried in all", "tried_each": "per measurement", "beside_tried": "of 35 % overlap tried [%]",
    "corner_tried": "of 12 % overlap tried [%]", "beside_used": "of 35 % overlap used [%]",
    "groups": "groups", "placed": "in the largest", "wrong": "wrong pairs used",
    "measurements_s": "measurements [s]", "pairs_s": "pairs [s]", "rest_s": "choice, network [s]",
    "seconds": "processor time [s]", "each_s": "each [s]", "mib": "peak memory [MiB]",
}  # fmt: skip


def save_growth() -> None:
    """Save the table of the cells that are there, with the exponent of the time."""
    rows = sorted((row for cell in read_cells(FOLDER) for row in cell["rows"]), key=lambda row: row["measurements"])
    sizes = " ".join(str(row["measurements"]) for row in rows)
    if len(rows) > 1:
        log = [np.log([row[key] for row in rows]) for key in ("measurements", "tried", "seconds", "pairs_s", "rest_s")]
        fitted = {
            key: float(np.polyfit(log[0], y, 1)[0])
            for key, y in zip(("tried", "seconds", "pairs_s", "rest_s"), log[1:], strict=True)
        }
        rows.append({"measurements": "fitted exponent", **fitted})
    rows = [{key: _text(row, key) for key in COLUMNS} for row in rows]
    save_table(FOLDER, COLUMNS, rows, f"python benchmarks/network.py --sizes {sizes}", machine=machines(FOLDER))


def _text(row: dict[str, Any], key: str) -> Any:
    value = row.get(key)
    if not isinstance(value, float):
        return value
    if isinstance(row["measurements"], str):
        return f"{value:.2f}"
    return f"{value:.0f}" if key in ("mib", "seconds", "measurements_s", "pairs_s") else f"{value:.3g}"


def grown(sizes: Sequence[int], cache: Path, again: bool = False) -> None:
    """Run these sizes, one after the other, as far as they have not been run, and save the table."""
    run_cells(FOLDER, {f"{count:04d}": (count, str(cache)) for count in sorted(sizes)}, grow, 1, again)
    save_growth()


if __name__ == "__main__":
    print(json.dumps(run_here(Path(sys.argv[1]), Path(sys.argv[2]), sys.stdin.read().split())))
