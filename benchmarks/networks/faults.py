"""Whole runs with something wrong in them: two parts mixed, a stranger, wrong pairs, a robot that errs.

Captures of the resolution and grain of grown.py, from files to registration.json. Wrong pairs are planted
where a run keeps its results: three accepted ones are moved by 5 mm along the surface and given the best evidence.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from networks.grown import coarse_scene, stand
from networks.rendered import OVERLAP, centroid_error, grid
from planish.execution.executor import Threads
from planish.files.given import GivenFiles
from planish.geometry import Array, compose, exp_so3, invert, perturb
from planish.pipeline import FileRun, register_files
from planish.pipeline.stages import PAIRS
from planish.registration.result import PairResult, Registration
from planish.simulation.scenes import Scene
from planish.simulation.surfaces import Cylinder, Door
from render_tables import save_table
from shared.rendered import measure_scene

#: A gently bent panel of 1.4 m x 1 m.
PANEL = Cylinder(half_s=700.0, half_t=500.0, radius=4000.0)
#: Noise of the robot [mm, rad], and by how much it errs once [mm].
ROBOT_MM, ROBOT_RAD, ROBOT_WRONG_MM = 1.0, 0.001, 20.0
#: Wrong pairs, and by how much they are wrong [mm].
PLANTED, PLANTED_MM = 3, 5.0

#: Overlap of neighbours where pairs are wrong: those at corners are accepted, too, so that each measurement has three
#: pairs at least. Of two that contradict each other nothing can say which one is wrong.
CLOSE = 0.5

Row = dict[str, Any]
Truth = dict[str, tuple[str, Array]]


def panel(part: str, columns: int, rows: int, seed: int, overlap: float = OVERLAP) -> Scene:
    """Return the captures of a panel."""
    rng = np.random.default_rng([seed, 11])
    return coarse_scene(part, PANEL, [stand(PANEL, s, t, rng) for s, t in grid(columns, rows, overlap)], seed)


def stranger(seed: int) -> Scene:
    """Return one capture of another part with the same kind of grain."""
    return coarse_scene("door", Door(), [stand(Door(), 0, 0, np.random.default_rng([seed, 12]))], seed)


def measure_mixed(scenes: Sequence[Scene], folder: Path, seed: int) -> Truth:
    """Write the measurements of all scenes under names that say nothing; return part and true place by name."""
    captures = [(scene, k) for scene in scenes for k in range(len(scene.names))]
    truth: Truth = {}
    for number, which in enumerate(np.random.default_rng([seed, 13]).permutation(len(captures))):
        scene, k = captures[which]
        # One sensor sees all parts.
        seen = replace(scene, sensor=replace(scene.sensor, seed=1))
        name = f"m{number:02d}"
        replace(measure_scene(seen, k), name=name).save(folder / f"{name}.h5")
        truth[name] = scene.part, scene.T_object_sensor[k]
    return truth


def run(folder: Path, given: GivenFiles | None = None) -> FileRun:
    """Register all measurements of a folder."""
    with Threads(1) as executor:
        return register_files(sorted(folder.glob("*.h5")), folder / "out", given=given, executor=executor)


def write_prior(truth: Truth, path: Path, seed: int) -> str:
    """Write what a robot says of all measurements; return for which it is wrong."""
    rng = np.random.default_rng([seed, 14])
    # The robot's frame is any other than the part's.
    T_robot_object = compose(exp_so3([0.3, -0.2, 1.0]), np.array([500.0, -200.0, 900.0]))
    bad = str(rng.choice(sorted(truth)))
    rows = []
    for name, (_, T) in truth.items():
        xi = np.r_[ROBOT_RAD * rng.standard_normal(3), ROBOT_MM * rng.standard_normal(3)]
        xi[3] += ROBOT_WRONG_MM * (name == bad)
        place = T_robot_object @ T
        place = perturb(place, xi, place[:3, 3])
        rows.append(
            {"name": name, "T_world_measurement": place.tolist(), "sigma_mm": ROBOT_MM,
             "sigma_deg": float(np.rad2deg(ROBOT_RAD))}
        )  # fmt: skip
    path.write_text(json.dumps({"schema": "planish.prior/1", "measurements": rows}), encoding="utf-8")
    return bad


def plant(done: FileRun, seed: int) -> set[tuple[str, str]]:
    """Make some accepted pairs wrong where the run keeps them; return which."""
    rng = np.random.default_rng([seed, 15])
    accepted = [p for p in done.registration.pairs if p.used]
    best = min(p.log10_false_alarms for p in accepted)
    chosen = [accepted[k] for k in rng.choice(len(accepted), PLANTED, replace=False)]
    for pair in chosen:
        stage = done.pairs[pair.a, pair.b]
        found = stage.store.read(PAIRS, stage.key, PairResult)
        assert found is not None
        assert found.T_a_b is not None
        assert found.covariance_point_mm is not None
        angle = rng.uniform(0, 2 * np.pi)
        xi = np.array([0, 0, 0, PLANTED_MM * np.cos(angle), PLANTED_MM * np.sin(angle), 0])
        wrong = replace(
            found, T_a_b=perturb(found.T_a_b, xi, found.covariance_point_mm), log10_false_alarms=best - 10
        )  # fmt: skip
        stage.store.write(PAIRS, stage.key, wrong)
    return {(pair.a, pair.b) for pair in chosen}


def assess(truth: Mapping[str, tuple[str, Array]], result: Registration) -> Row:
    """Return how parts and groups agree, and the largest error along the surface of what is in a group."""
    members: dict[int, list[str]] = {}
    for m in result.measurements:
        members.setdefault(m.group, []).append(m.name)
    placed = {m.name: m for m in result.measurements}
    worst = 0.0
    for group in result.groups:
        reference = truth[group.reference]
        for name in members[group.id]:
            if name != group.reference and truth[name][0] == reference[0]:
                T_true = invert(reference[1]) @ truth[name][1]
                worst = max(worst, centroid_error(placed[name], T_true, T_true[:3, 2])[0])
    return {
        "measurements": len(placed), "parts": len({part for part, _ in truth.values()}), "groups": len(members),
        "sizes": " + ".join(str(len(names)) for names in sorted(members.values(), key=len, reverse=True)),
        "mixed": sum(len({truth[name][0] for name in names}) > 1 for names in members.values()),
        "along_mm": worst,
    }  # fmt: skip


def cases(folder: Path, seed: int) -> list[Row]:
    """Return the rows of all cases."""
    rows: list[Row] = []

    def add(what: str, truth: Truth, result: Registration, started: float, **more: Any) -> None:
        seconds = time.process_time() - started
        rows.append({"what": what, **assess(truth, result), **more, "seconds": seconds})
        print(rows[-1], flush=True)

    for what, scenes in (
        ("two panels mixed", [panel("one", 3, 2, seed), panel("two", 3, 2, seed + 100)]),
        ("a panel and one of another part", [panel("one", 3, 2, seed), stranger(seed + 200)]),
    ):
        started, here = time.process_time(), folder / what.replace(" ", "_")
        here.mkdir()
        truth = measure_mixed(scenes, here, seed)
        add(what, truth, run(here).registration, started)
    started, here = time.process_time(), folder / "one"
    here.mkdir()
    truth = measure_mixed([panel("one", 4, 3, seed, CLOSE)], here, seed)
    done = run(here)
    bad = write_prior(truth, here / "prior.json", seed)
    result = run(here, GivenFiles(prior=here / "prior.json")).registration
    unused = {test.measurement for test in result.network.given if not test.used}
    add(f"a robot wrong by {ROBOT_WRONG_MM:.0f} mm for one measurement", truth, result, started,
        planted=1, named=len(unused & {bad}), right=len(unused - {bad}))  # fmt: skip
    started = time.process_time()
    wrong = plant(done, seed)
    result = run(here).registration
    out = {(p.a, p.b) for p in result.pairs if p.status == "accepted" and not p.used and p.removed_reason}
    add(f"{PLANTED} pairs wrong by {PLANTED_MM:.0f} mm", truth, result, started,
        planted=len(wrong), named=len(out & wrong), right=len(out - wrong))  # fmt: skip
    return rows


COLUMNS = {
    "what": "run", "measurements": "measurements", "parts": "parts", "groups": "groups", "sizes": "their sizes",
    "mixed": "groups of two parts", "planted": "wrong statements", "named": "of them named and unused",
    "right": "right ones left out", "along_mm": "along, worst [mm]", "seconds": "processor time [s]",
}  # fmt: skip


def faults(seed: int = 1) -> None:
    """Run all cases and save their table."""
    with tempfile.TemporaryDirectory() as folder:
        rows = cases(Path(folder), seed)
    command = "python benchmarks/network.py --rendered small"
    save_table("network-faults", COLUMNS, rows, command, {"along_mm": ".3f", "seconds": ".0f"})
