"""Rendered networks: a panel in a grid, and a ring around its rim, measured, registered and compared with the truth.

Full: 40 captures of a panel of 2.4 m x 1.2 m (8 x 5) and 16 around the rim of 6 x 4 of its places, at the paper's
resolution. By the times of benchmarks/speed.py a capture costs 3 s and a pair up to 3 s of one core: 780 and 120 pairs
are some 45 and 10 minutes for one seed and one rig. Small: 3 x 2 and the ring at a reduced resolution, some minutes.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from planish.geometry import Array, invert, transform_points
from planish.pipeline import register_run
from planish.registration.result import PlacedMeasurement, Registration
from planish.simulation.scenes import Scene, make_scene, place_sensor
from planish.simulation.surfaces import Cylinder
from render_tables import save_table
from shared.rendered import measure_scene

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
    """Return the error of the centroid along the surface and its normal [mm], and the former's predicted sigma."""
    point = placed.covariance_point_mm
    here = transform_points(invert(placed.T_world_measurement), point)
    e = point - transform_points(T_true, np.asarray(here, float))
    along = np.eye(3) - np.outer(normal_world, normal_world)
    C = placed.covariance_noise[3:, 3:]
    return float(np.linalg.norm(along @ e)), float(abs(normal_world @ e)), float(np.sqrt(np.trace(along @ C @ along)))


def assess(scene: Scene, result: Registration) -> dict[str, Any]:
    """Return the figures of one network; the world is the reference of the largest group."""
    places = dict(zip(scene.names, scene.T_object_sensor, strict=True))
    reference = result.groups[0].reference
    T_world_object = invert(places[reference])
    along, normal, beyond = [], [], 0
    for m in result.measurements:
        if m.group or m.name == reference:
            continue
        T_true = T_world_object @ places[m.name]
        # The sensor looks along its own -z at the middle of what it sees.
        e_t, e_n, sigma = centroid_error(m, T_true, T_true[:3, 2])
        along.append(e_t)
        normal.append(e_n)
        beyond += e_t > 3 * sigma
    loops = result.network.loops
    worst = max(loops, key=lambda loop: (len(loop.measurements), loop.closure_mm), default=None)
    return {
        "measurements": len(result.measurements), "groups": len(result.groups),
        "accepted": sum(p.status == "accepted" for p in result.pairs),
        "unused": sum(p.status == "accepted" and not p.used for p in result.pairs),
        "along95_mm": float(np.percentile(along, 95)), "along_max_mm": float(max(along)),
        "normal_max_mm": float(max(normal)), "beyond": int(beyond),
        "loop": len(worst.measurements) if worst else 0,
        "closure_mm": worst.closure_mm if worst else None, "predicted_mm": worst.predicted_mm if worst else None,
    }  # fmt: skip


COLUMNS = {
    "network": "network", "scale": "resolution", "measurements": "measurements", "groups": "groups",
    "accepted": "pairs accepted", "unused": "of them taken out", "along95_mm": "along, 95 % [mm]",
    "along_max_mm": "along, worst [mm]", "normal_max_mm": "normal, worst [mm]", "beyond": "beyond 3 sigma",
    "loop": "longest loop", "closure_mm": "its closure [mm]", "predicted_mm": "predicted [mm]",
    "seconds": "processor time [s]",
}  # fmt: skip


def rendered(size: str, seed: int = 1) -> None:
    """Render, measure, register and compare the small or the full networks; saves the table network-rendered."""
    scale = 1.0 if size == "full" else 0.4
    wanted = {
        "panel, 8 x 5" if size == "full" else "panel, 3 x 2": grid(8, 5) if size == "full" else grid(3, 2),
        "ring of 16": rim(6, 4),
    }
    rows = []
    for name, places in wanted.items():
        started = time.process_time()
        scene = scene_of(places, seed, scale)
        result = register_run([measure_scene(scene, k) for k in range(len(places))], threads=1).registration
        seconds = time.process_time() - started
        rows.append({"network": name, "scale": scale, "seconds": seconds, **assess(scene, result)})
        print(rows[-1], flush=True)
        for line in result.network.warnings:
            print("   ", line, flush=True)
    formats = {key: ".4f" for key in COLUMNS if key.endswith("_mm")} | {"seconds": ".0f"}
    save_table(f"network-rendered-{size}", COLUMNS, rows, f"python benchmarks/network.py --rendered {size}", formats)
