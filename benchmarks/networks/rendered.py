"""Rendered networks: a panel in a grid, and a ring around its rim, measured, registered and compared with the truth.

Full: 40 captures of a panel of 2.4 m x 1.2 m (8 x 5) and 16 around the rim of 6 x 4 of its places, at the paper's
resolution. Small: 3 x 2 and the ring at a reduced resolution. Each capture is rendered once and measured with the true
rig and with one drawn from the covariance of a calibration by 20 boards (0.05 px), which the rig then states as its
own. Files are registered as a user would, in one thread; they are kept in the cache folder until their run is done.
"""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from planish.execution.executor import Threads
from planish.geometry import Array, invert, transform_points
from planish.pipeline import register_files
from planish.registration.result import PlacedMeasurement, Registration
from planish.simulation.rigs import draw_rig
from planish.simulation.scenes import Scene, make_scene, place_sensor
from planish.simulation.surfaces import Cylinder
from render_tables import ROOT, save_table
from shared.cells import Rows, machines, read_rows, run_cells
from shared.rendered import measure_rendered, render_scene

sys.path.append(str(ROOT / "tests"))
from calibrated_rig import with_calibration

FOLDER = "network-rendered"

#: A gently bent panel, 2.46 m along the bend and 1.22 m across: neither geometry nor edges hold it.
PANEL = Cylinder(half_s=1230.0, half_t=610.0, radius=4000.0)
#: Field of the reference sensor [mm] and the overlap of neighbours.
FIELD_MM, OVERLAP = (444.0, 332.0), 0.35
GRAIN = 0.03


def grid(columns: int, rows: int, overlap: float = OVERLAP) -> list[tuple[float, float]]:
    """Return the places (s, t) [mm] of a grid about the middle of the panel."""
    step_s, step_t = ((1 - overlap) * size for size in FIELD_MM)
    return [
        (step_s * (i - (columns - 1) / 2), step_t * (j - (rows - 1) / 2)) for j in range(rows) for i in range(columns)
    ]


def rim(columns: int, rows: int) -> list[tuple[float, float]]:
    """Return those places of a grid that lie at its rim."""
    inner = {(i, j) for i in range(1, columns - 1) for j in range(1, rows - 1)}
    return [place for k, place in enumerate(grid(columns, rows)) if (k % columns, k // columns) not in inner]


def scene_of(places: list[tuple[float, float]], seed: int, scale: float) -> Scene:
    """Return the captures in shuffled order, rolled, tilted and at distances as a hand or robot would."""
    rng = np.random.default_rng([seed, 5])
    scene = replace(make_scene("cylinder", seed, 2, grain=GRAIN, scale=scale), surface=PANEL)
    stands = [
        place_sensor(
            PANEL, s + rng.uniform(-8, 8), t + rng.uniform(-8, 8), rng.choice([0.0, 180.0]) + rng.uniform(-4, 4),
            (rng.uniform(-6, 6), rng.uniform(-6, 6)), rng.uniform(-15, 15),
        )
        for s, t in places
    ]  # fmt: skip
    return scene.seen_from([stands[k] for k in rng.permutation(len(stands))])


def centroid_error(placed: PlacedMeasurement, T_true: Array, normal_world: Array) -> tuple[float, float, float]:
    """Return the error of the centroid along the surface and its normal [mm], and the former's predicted sigma.

    Predicted by noise and, where the rig states it, calibration.
    """
    point = placed.covariance_point_mm
    here = transform_points(invert(placed.T_world_measurement), point)
    e = point - transform_points(T_true, np.asarray(here, float))
    along = np.eye(3) - np.outer(normal_world, normal_world)
    C = placed.covariance_noise[3:, 3:]
    if placed.covariance_calibration is not None:
        C = C + placed.covariance_calibration[3:, 3:]
    return float(np.linalg.norm(along @ e)), float(abs(normal_world @ e)), float(np.sqrt(np.trace(along @ C @ along)))


def assess(scene: Scene, result: Registration) -> dict[str, Any]:
    """Return the figures of one network; the world is the reference of the largest group."""
    places = dict(zip(scene.names, scene.T_object_sensor, strict=True))
    reference = result.groups[0].reference
    T_world_object = invert(places[reference])
    along, normal, sigmas, beyond = [], [], [], 0
    for m in result.measurements:
        if m.group or m.name == reference:
            continue
        T_true = T_world_object @ places[m.name]
        # The sensor looks along its own -z at the middle of what it sees.
        e_t, e_n, sigma = centroid_error(m, T_true, T_true[:3, 2])
        along.append(e_t)
        normal.append(e_n)
        sigmas.append(sigma)
        beyond += e_t > 3 * sigma
    loops = result.network.loops
    worst = max(loops, key=lambda loop: (len(loop.measurements), loop.closure_mm), default=None)
    return {
        "measurements": len(result.measurements), "groups": len(result.groups),
        "tried": len(result.pairs),
        "accepted": sum(p.status == "accepted" for p in result.pairs),
        "unused": sum(p.status == "accepted" and not p.used for p in result.pairs),
        "along95_mm": float(np.percentile(along, 95)), "along_max_mm": float(max(along)),
        "normal_max_mm": float(max(normal)), "sigma_max_mm": float(max(sigmas)), "beyond": int(beyond),
        "loop": len(worst.measurements) if worst else 0,
        "closure_mm": worst.closure_mm if worst else None, "predicted_mm": worst.predicted_mm if worst else None,
    }  # fmt: skip


COLUMNS = {
    "network": "network", "rig": "rig", "scale": "resolution", "measurements": "measurements", "groups": "groups",
    "tried": "pairs tried", "accepted": "accepted", "unused": "of them taken out", "along95_mm": "along, 95 % [mm]",
    "along_max_mm": "along, worst [mm]", "normal_max_mm": "normal, worst [mm]", "sigma_max_mm": "predicted, worst [mm]",
    "beyond": "beyond 3 sigma", "loop": "longest loop", "closure_mm": "its closure [mm]",
    "predicted_mm": "predicted [mm]", "seconds": "processor time [s]",
}  # fmt: skip
#: Columns and rows of the panels by size, and the resolution.
SIZES = {"small": (3, 2, 0.4), "full": (8, 5, 1.0)}
RIGS = ("exact", "drawn")


def places_of(size: str, network: str) -> list[tuple[float, float]]:
    """Return where the captures of a network stand."""
    return rim(6, 4) if network == "ring of 16" else grid(*SIZES[size][:2])


def make_measurements(scene: Scene, folder: Path, seed: int) -> dict[str, list[Path]]:
    """Render the captures whose files are not there, measure them with both rigs; return the files of each."""
    files = {rig: [folder / rig / f"{name}.h5" for name in scene.names] for rig in RIGS}
    rigs = {"exact": None, "drawn": draw_rig(with_calibration(scene.rig), seed)}
    for k in range(len(scene.names)):
        missing = [rig for rig in RIGS if not files[rig][k].is_file()]
        if not missing:
            continue
        capture = render_scene(scene, k)
        for rig in missing:
            files[rig][k].parent.mkdir(parents=True, exist_ok=True)
            part = files[rig][k].with_suffix(".part")
            measure_rendered(capture, rigs[rig]).save(part)
            part.replace(files[rig][k])
        print(f"    {folder.name}: {k + 1} of {len(scene.names)} measured", flush=True)
    return files


def run_network(size: str, network: str, seed: int, cache: str) -> Rows:
    """Return one row per rig: a network measured, registered and compared with the truth."""
    scale = SIZES[size][2]
    scene = scene_of(places_of(size, network), seed, scale)
    folder = Path(cache) / f"{size}_{network.replace(' ', '_')}_{seed}"
    files = make_measurements(scene, folder, seed)
    rows: Rows = []
    for rig in RIGS:
        started = time.process_time()
        with Threads(1) as executor:
            result = register_files(files[rig], folder / f"{rig}_registered", executor=executor).registration
        seconds = time.process_time() - started
        rows.append({"network": network, "size": size, "rig": rig, "seed": seed, "scale": scale, "seconds": seconds})
        rows[-1] |= assess(scene, result) | {"warnings": list(result.network.warnings)}
        print(rows[-1], flush=True)
    shutil.rmtree(folder)
    return rows


def rendered(size: str, cache: Path, workers: int, again: bool, seed: int = 1) -> None:
    """Run the small or the full networks, in cells, and save the table network-rendered-small or -full."""
    panel = f"panel, {SIZES[size][0]} x {SIZES[size][1]}"
    cells = {
        f"{size}_{name.split()[0].strip(',')}_{seed}": (size, name, seed, str(cache)) for name in (panel, "ring of 16")
    }
    run_cells(FOLDER, cells, run_network, workers, again)
    rows = [row for row in read_rows(FOLDER) if row["size"] == size]
    formats = {key: ".4f" for key in COLUMNS if key.endswith("_mm")} | {"seconds": ".0f"}
    command = f"python benchmarks/network.py --rendered {size}"
    save_table(f"network-rendered-{size}", COLUMNS, rows, command, formats, machine=machines(FOLDER))
