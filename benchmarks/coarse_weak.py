"""The weakest texture: plate and cylinder, brushed grain and nothing else, overlap about 40 %, full resolution.

    python benchmarks/coarse_weak.py --pairs 100
    python benchmarks/coarse_weak.py --bounds                 (the least error that some of these pairs can have)
    python benchmarks/coarse_weak.py --tables

Seven captures of each part stand such that many of their pairs overlap by 40 %, and all these are cases: they share
the part's grain and the sensor with its pixel response, not noise and positions. The first part of each kind is
registered from the white images alone, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np

from coarse import error_mm
from coarse_pairs.parts import (
    CLOSER_MM,
    MAX_TILT_DEG,
    PLAN_ERROR,
    Case,
    Part,
    Seen,
    Stand,
    find_cases,
    measure_part,
    seen_overlap,
    true_transform,
)
from coarse_pairs.tables import RIGHT_MM
from planish.evaluation.prepared import Prepared as Evaluated
from planish.evaluation.truth import error_rms, true_overlap
from planish.geometry import transform_points
from planish.measurement import Measurement
from planish.pipeline import prepare_run
from planish.registration.pair import register_pair
from planish.simulation.scenes import make_scene
from refined_pairs.bound import pair_bound
from refined_pairs.true_view import true_view
from render_tables import save_table
from shared.cells import Rows, cell_arguments, machines, read_rows, run_cells
from shared.rendered import measure_scene

FOLDER = "coarse-weak"
SURFACES, GRAINS = ("plate", "cylinder"), (0.01, 0.005, 0.0025, 0.00125)
OVERLAP, CAPTURES, PAIRS_PER_PART = 0.4, 7, 10
#: Highlights are weak here: grain is to be all there is.
SPECULAR = 0.02
#: Grid of the captures before it is adjusted [mm], steps of the adjustment and its largest move.
GRID_MM, STEPS, MOVE_MM = 150.0, 250, 30.0
#: Pairs of a part whose least possible error is computed, and points of the overlap at which it is evaluated.
BOUNDED, BOUND_POINTS = 4, 5000
#: What is asked after refinement along the surface [mm].
ALONG_MM = 0.05


def draw_weak_part(surface: str, grain: float, number: int) -> tuple[Part, list[Case]]:
    """Return a part with nothing but grain, and its pairs of 40 % overlap: captures on a hexagon, moved until they fit.

    Numbers and surfaces fix the stands, whatever the grain.
    """
    seed = 1000 * SURFACES.index(surface) + number
    rng = np.random.default_rng([seed, 11])
    part = Part(seed, surface, 0.0, grain, SPECULAR, 1.0)
    scene = make_scene(surface, seed, scale=0.25)
    stands = [_stand(k, rng) for k in range(CAPTURES)]
    views = [_seen(scene, s) for s in stands]
    value = _misfit(views)
    for step in range(STEPS):
        k = step % CAPTURES
        move = rng.normal(0, MOVE_MM * (1 - step / STEPS) + 2, 2)
        moved = replace(stands[k], s=round(stands[k].s + move[0], 2), t=round(stands[k].t + move[1], 2))
        trial = _seen(scene, moved)
        other = _misfit([*views[:k], trial, *views[k + 1 :]])
        if trial is not None and other < value:
            stands[k], views[k], value = moved, trial, other
    part = replace(part, stands=tuple(stands))
    return part, find_cases(scene.surface, scene.rig, part.stands, (OVERLAP, OVERLAP))


def _stand(k: int, rng: np.random.Generator) -> Stand:
    angle = np.pi / 3 * k
    at = np.zeros(2) if k == CAPTURES - 1 else GRID_MM * np.array([np.cos(angle), np.sin(angle)])
    tilt, around = 0.5 * MAX_TILT_DEG * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    return Stand(
        s=round(float(at[0]), 2), t=round(float(at[1]), 2), roll_deg=round(rng.uniform(0, 360), 2),
        tilt_deg=(round(tilt * np.cos(around), 2), round(tilt * np.sin(around), 2)),
        closer_mm=round(rng.uniform(-CLOSER_MM, CLOSER_MM), 1),
    )  # fmt: skip


def _seen(scene: Any, stand: Stand) -> Seen | None:
    T = stand.place(scene.surface)
    return None if T is None else Seen.of(scene.surface, scene.rig, T)


def _misfit(views: list[Seen | None]) -> float:
    """Return minus the number of pairs that fit, softened so that pairs near to fitting are drawn in."""
    if any(v is None for v in views):
        return 0.0
    known = [v for v in views if v is not None]
    off = [seen_overlap(a, b) - OVERLAP for i, a in enumerate(known) for b in known[:i]]
    return -float(np.exp(-0.5 * (np.array(off) / PLAN_ERROR) ** 2).sum())


def white_alone(m: Measurement) -> Measurement:
    """Return the measurement as if the white image were all that was seen."""
    views = {name: replace(view, mean=None, modulation=None) for name, view in m.views.items()}
    return replace(m, views=views)


def run_part(surface: str, grain: float, number: int, with_white: bool) -> Rows:
    """Return the records of all pairs of one part."""
    part, cases = draw_weak_part(surface, grain, number)
    measured = measure_part(part)
    kinds: dict[str, Mapping[int, Measurement]] = {"sequence": measured}
    if with_white:
        kinds["white"] = {index: white_alone(m) for index, m in measured.items()}
    return [row for kind, of_it in kinds.items() for row in _run_kind(part, cases, kind, of_it)]


def _run_kind(part: Part, cases: list[Case], kind: str, measured: Mapping[int, Measurement]) -> Rows:
    options, prepared = prepare_run(list(measured.values()), threads=1)
    rows: Rows = []
    for case in cases:
        row: dict[str, Any] = {
            "kind": kind, "surface": part.surface, "grain": part.grain, "number": part.number,
            "first": case.first, "second": case.second,
        }  # fmt: skip
        rows.append(row)
        if not {case.first, case.second} <= set(measured):
            row["status"] = "not measured"
            continue
        a, b = (prepared[measured[i].name] for i in (case.first, case.second))
        sides = [Evaluated(p.measurement, p.surface, p.contrast) for p in (a, b)]
        T = true_transform(part, case)
        result = register_pair(a, b, options, 1, 1)
        overlap, inside = true_overlap(sides[0], sides[1], T, 1)
        rms = None if result.T_a_b is None else error_rms(result.T_a_b, T, sides[1], inside)
        row |= {
            "overlap": round(overlap, 3),
            "status": result.status,
            "reason": result.reason,
            "matches": result.matches,
            "places": result.consensus,
            "log10_false_alarms": round(result.log10_false_alarms, 2),
            "coarse_mm": error_mm(result.T_coarse_a_b, T, b.measurement.points_sensor[inside].astype(float)[::50]),
            "along_mm": None if rms is None else round(rms[0], 4),
            "normal_mm": None if rms is None else round(rms[1], 4),
        }
    return rows


def run_bound(surface: str, grain: float, number: int) -> Rows:
    """Return the least error along the surface that the first pairs of a part can have (`refined_pairs/bound.py`)."""
    part, cases = draw_weak_part(surface, grain, number)
    scene, rows = part.scene(), []
    chosen = cases[:BOUNDED]
    indices = sorted({index for case in chosen for index in (case.first, case.second)})
    views = {k: true_view(scene, k, measure_scene(scene, k).valid) for k in indices}
    for case in chosen:
        T, a, b = true_transform(part, case), views[case.first], views[case.second]
        points, normals = transform_points(T, b.points), b.normals @ T[:3, :3].T
        pixels, (height, width) = a.camera.project(points), a.known.shape
        seen = b.known & ((pixels >= 0) & (pixels < (width, height))).all(-1)
        some = np.flatnonzero(seen.ravel())[:: max(1, int(seen.sum()) // BOUND_POINTS)]
        points, normals = (v.reshape(-1, 3)[some] for v in (points, normals))
        along, normal = pair_bound(a, b, T, points.mean(0)).errors_mm(points, normals, points.mean(0))
        rows.append({
            "kind": "bound", "surface": surface, "grain": grain, "number": number, "first": case.first,
            "second": case.second, "along_mm": round(along, 4), "normal_mm": round(normal, 5),
        })  # fmt: skip
    return rows


def save_tables() -> None:
    """Save the table `coarse-weak` and print the pairs that failed."""
    rows = [r for r in read_rows(FOLDER) if r.get("status") != "not measured"]
    bounds = [r for r in rows if r["kind"] == "bound"]
    table = []
    for kind, heading in (("sequence", "whole sequence"), ("white", "white image alone")):
        for surface in SURFACES:
            for grain in GRAINS:
                of_it = [r for r in rows if (r["kind"], r["surface"], r["grain"]) == (kind, surface, grain)]
                if of_it:
                    table.append({"texture": heading, "surface": surface, "grain": 100 * grain} | _summary(of_it))
                least = [r["along_mm"] for r in bounds if (r["surface"], r["grain"]) == (surface, grain)]
                if of_it and kind == "sequence" and least:
                    table[-1]["least"] = median(least)
    columns = {
        "texture": "texture from", "surface": "surface", "grain": "grain [%]", "pairs": "pairs", "accepted": "accepted",
        "wrong": "of them wrong", "sure": "log10 false alarms <= -6", "places": "distinct places, median",
        "alarms": "log10 false alarms, median", "along": "along the surface, median [mm]",
        "least": "least possible, median [mm]", "along_worst": "worst [mm]", "along_good": "<= 0.05 mm",
    }  # fmt: skip
    formats = {"along": ".4f", "least": ".4f", "along_worst": ".4f", "alarms": ".0f"}
    if table:
        save_table("coarse-weak", columns, table, "python benchmarks/coarse_weak.py", formats, machine=machines(FOLDER))
    for row in table:
        print(row)
    for r in rows:
        if r["kind"] == "sequence" and (r["status"] != "accepted" or r["along_mm"] is None or r["along_mm"] > ALONG_MM):
            print(r)


def _summary(rows: Rows) -> dict[str, Any]:
    accepted = [r for r in rows if r["status"] == "accepted"]
    # An accepted pair whose truth holds no overlap would have no error, and is wrong all the same.
    along = [r["along_mm"] if r["along_mm"] is not None else float("inf") for r in accepted]
    return {
        "pairs": len(rows),
        "accepted": len(accepted),
        "wrong": sum(a > RIGHT_MM for a in along),
        "sure": sum(r["log10_false_alarms"] <= -6 for r in accepted),
        "places": median([r["places"] for r in rows]),
        "alarms": median([r["log10_false_alarms"] for r in rows]),
        "along": median(along) if along else None,
        "along_worst": max(along) if along else None,
        "along_good": sum(a <= ALONG_MM for a in along),
    }


def main() -> None:
    parser = cell_arguments(__doc__)
    parser.add_argument("--pairs", type=int, default=100, help="of each surface and grain")
    parser.add_argument("--grains", type=float, nargs="+", default=GRAINS)
    parser.add_argument("--bounds", action="store_true", help="only the least possible errors of the first pairs")
    arguments = parser.parse_args()
    if arguments.bounds:
        cells = {f"bound_{s}_{100 * g:g}": (s, g, 0) for g in arguments.grains for s in SURFACES}
        run_cells(FOLDER, cells, run_bound, arguments.workers, arguments.again)
    elif not arguments.tables:
        cells = {}
        for number in range(-(-arguments.pairs // PAIRS_PER_PART)):
            for grain in arguments.grains:
                for surface in SURFACES:
                    name = f"{surface}_{100 * grain:g}_{number:03d}"
                    cells[name] = (surface, grain, number, number == 0)
        run_cells(FOLDER, cells, run_part, arguments.workers, arguments.again)
    save_tables()


if __name__ == "__main__":
    main()
