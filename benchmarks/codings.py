"""Simulated captures of every coding, geometry and light against truth, without any spatial filter.

python benchmarks/codings.py --seeds 1 2
python benchmarks/codings.py --seeds 1 2 --only "gray.*camera"    (measures these rows again, keeps the others)

A row that cannot be decoded stands in the table with the reason. Errors are those along the organising camera's ray;
normalised = divided by the predicted sigma, clipped at 10 for the rms (what lies beyond has a column of its own).
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from planish.errors import InputError
from planish.measurement import Measurement
from planish.pipeline import measure
from planish.rig import Rig
from planish.sensing.capture.manifest import Capture
from planish.sensing.patterns.entries import Entry
from planish.sensing.patterns.sequences import named_sequence, with_exposures
from planish.simulation.highlights import with_highlights
from planish.simulation.render import trace_capture
from planish.simulation.scenes import Scene, make_scene
from planish.simulation.writing import write_scene
from points import spread
from render_tables import RESULTS, save_table

SCENES = ("plate", "door")
STEREO, PROCAM, THREE = "two cameras", "camera and projector", "three rays"
#: Normalised errors beyond are counted, not averaged.
BEYOND = 10.0


def _lit(sensor: dict[str, float] | None = None, light: dict[str, float] | None = None) -> Callable[[Scene], Scene]:
    return lambda scene: replace(
        scene, sensor=replace(scene.sensor, **(sensor or {})), light=replace(scene.light, **(light or {}))
    )


#: Changes of the scene by name. Light of the room as bright as the projector's white needs a shorter exposure.
CONDITIONS: dict[str, Callable[[Scene], Scene]] = {
    "reference": lambda scene: scene,
    "highlights saturate 5 %": lambda scene: with_highlights(scene, 0.05),
    "ambient as bright as the fringes": _lit({"exposure": 0.6}, {"ambient": 1.0}),
    "projector gamma 2.2": _lit({"projector_gamma": 2.2}),
    "camera gamma 2.2": _lit({"gamma": 2.2}),
    "a quarter of the light": _lit({"exposure": 0.25}),
}
REFERENCE = ("reference",)
ALL = tuple(CONDITIONS)


@dataclass(frozen=True)
class Coding:
    """A sequence by name and options, and in which geometries and conditions it is measured."""

    what: str
    sequence: str
    options: dict[str, object] = field(default_factory=dict)
    geometries: tuple[str, ...] = (STEREO, PROCAM, THREE)
    conditions: tuple[str, ...] = REFERENCE
    exposures_ms: tuple[float, ...] = ()

    def entries(self) -> tuple[Entry, ...]:
        """Return what is projected."""
        entries = named_sequence(self.sequence, **self.options)
        return tuple(with_exposures(entries, self.exposures_ms) if self.exposures_ms else entries)


BOTH = {"axes": ("u", "v")}
CODINGS = (
    Coding("reference sequence", "reference", {}, conditions=ALL),
    Coding("one period, 8 steps", "phase-shift"),
    Coding("multi-frequency, 3 steps", "multi-frequency", {"steps": 3}, conditions=ALL),
    Coding("multi-frequency, 4 steps", "multi-frequency", {"steps": 4}),
    Coding("multi-frequency, 4 steps, sign -1", "multi-frequency", {"steps": 4, "sign": -1}),
    Coding("multi-frequency, 5 steps", "multi-frequency", {"steps": 5}),
    Coding("multi-frequency, 8 steps", "multi-frequency", {"steps": 8}),
    Coding("multi-frequency, both axes", "multi-frequency", BOTH),
    Coding("heterodyne, 2 periods", "heterodyne", {"count": 2}),
    Coding("heterodyne, 3 periods", "heterodyne", {"count": 3}, conditions=ALL),
    Coding("Gray code + phase, complementary bit", "gray-phase", {}, conditions=ALL),
    Coding("Gray code + phase, no complementary bit", "gray-phase", {"complementary": False}),
    Coding("Gray code + phase, both axes", "gray-phase", BOTH),
    Coding("Gray code with inverses", "gray", {"inverses": True}, conditions=ALL),
    Coding("Gray code without inverses", "gray", {"inverses": False}),
    Coding("Gray code with inverses, both axes", "gray", {"inverses": True, **BOTH}),
    Coding("shifted square waves + Gray code", "square", {}, conditions=("reference", "a quarter of the light")),
    Coding("statistical, 24 patterns", "statistical", {}, (STEREO,), conditions=ALL),
    Coding("statistical, 12 patterns", "statistical", {"count": 12}, (STEREO,)),
    Coding("reference sequence at 20 and 5 ms", "reference", {}, conditions=ALL, exposures_ms=(20.0, 5.0)),
)  # fmt: skip


def as_geometry(folder: Path, scene: Scene, geometry: str) -> Scene:
    """Let the written capture have the devices of a geometry only; return the scene whose truth belongs to it."""
    manifest = json.loads((folder / "capture.json").read_text())
    if geometry == PROCAM:
        manifest["images"].pop("B")
        scene = replace(scene, rig=Rig({"A": scene.rig.cameras["A"]}, scene.rig.projector))
    known = Rig(scene.rig.cameras, None) if geometry == STEREO else scene.rig
    known.save(folder / "rig.json")
    (folder / "capture.json").write_text(json.dumps(manifest))
    return scene


@dataclass(frozen=True)
class Errors:
    """Errors of the points of one capture and what they are compared with."""

    error_mm: np.ndarray
    normalised: np.ndarray
    modulation: np.ndarray
    found: int
    seen: int


def errors(item: Measurement, scene: Scene) -> Errors:
    """Compare a measurement with the truth of its scene."""
    truth, seen = trace_capture(scene, 0, "A")
    both = item.valid & np.isfinite(truth[..., 2])
    ray = truth[both] - item.camera.center_sensor
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    error = ((item.points_sensor[both] - truth[both]) * ray).sum(1)
    view = item.views["A"]
    light = view.modulation if view.modulation is not None else view.white
    return Errors(error, error / item.sigma_mm[both], light[both], int((item.valid & seen).sum()), int(seen.sum()))


def summary(parts: list[Errors]) -> dict[str, float | int]:
    """Figures over all captures of a row; deciles of modulation are those of each capture."""
    e, z = (np.concatenate([getattr(part, name) for part in parts]) for name in ("error_mm", "normalised"))
    ranks = [np.argsort(np.argsort(part.modulation, kind="stable")) * 10 // len(part.modulation) for part in parts]
    decile = np.concatenate(ranks)
    clipped = np.clip(z, -BEYOND, BEYOND) ** 2
    by_decile = [float(np.sqrt(clipped[decile == k].mean())) for k in range(10)]
    return {
        "points": len(e),
        "share": sum(part.found for part in parts) / sum(part.seen for part in parts),
        "sigma": spread(e),
        "robust": spread(z),
        "rms": float(np.sqrt(clipped.mean())),
        "least": min(by_decile),
        "most": max(by_decile),
        "beyond": float((np.abs(z) > BEYOND).mean()),
    }


def measured(coding: Coding, condition: str, wanted: list[str], seeds: list[int], scale: float) -> Iterator[dict]:
    """Yield one row per geometry; each capture is rendered once for all of them."""
    parts: dict[str, list[Errors]] = {geometry: [] for geometry in wanted}
    notes: dict[str, str] = {}
    for name in SCENES:
        for seed in seeds:
            scene = CONDITIONS[condition](replace(make_scene(name, seed, 1, scale=scale), sequence=coding.entries()))
            with tempfile.TemporaryDirectory() as folder:
                (original,) = write_scene(scene, Path(folder), true_points=False)
                for number, geometry in enumerate(wanted):
                    place = Path(folder) / str(number)
                    place.mkdir()
                    for file in ("capture.json", "rig.json"):
                        shutil.copy(original / file, place)
                    known = as_geometry(place, scene, geometry)
                    try:
                        item = measure(Capture.load(place, original))
                    except InputError as error:
                        notes[geometry] = str(error).replace(str(place), "").lstrip("/")
                        continue
                    parts[geometry].append(errors(item, known))
    for geometry in wanted:
        row = {"coding": coding.what, "geometry": geometry, "condition": condition, "note": notes.get(geometry, "")}
        complete = parts[geometry] and all(len(part.error_mm) > 10 for part in parts[geometry])
        yield row | (summary(parts[geometry]) if complete else {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--scale", type=float, default=1.0, help="resolution of the cameras; nothing is saved below 1")
    parser.add_argument("--only", default="", help="regular expression for 'coding, geometry, condition'")
    given = parser.parse_args()
    path = RESULTS / "codings.json"
    rows = {}
    if given.only and path.is_file():
        saved = json.loads(path.read_text(encoding="utf-8"))["rows"]
        rows = {(row["coding"], row["geometry"], row["condition"]): row for row in saved}
    for coding in CODINGS:
        for condition in coding.conditions:
            wanted = [g for g in coding.geometries if re.search(given.only, f"{coding.what}, {g}, {condition}")]
            for row in measured(coding, condition, wanted, given.seeds, given.scale) if wanted else ():
                rows[row["coding"], row["geometry"], row["condition"]] = row
                print({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    order = [(c.what, g, x) for c in CODINGS for x in c.conditions for g in c.geometries]
    columns = {"coding": "coding", "geometry": "geometry", "condition": "light", "points": "points",
               "share": "of the pixels all devices see", "sigma": "robust sigma along the ray [mm]",
               "robust": "robust sigma / predicted", "rms": "rms of error / predicted",
               "least": "least, of ten deciles of modulation", "most": "most", "beyond": "beyond 10 predicted",
               "note": "note"}  # fmt: skip
    if given.scale == 1:
        save_table("codings", columns, [rows[key] for key in order if key in rows],
                   "python benchmarks/codings.py --seeds " + " ".join(map(str, given.seeds)),
                   {"share": ".2%", "sigma": ".4f", "robust": ".3f", "rms": ".3f", "least": ".3f", "most": ".3f",
                    "beyond": ".1e", "points": ",d"})  # fmt: skip


if __name__ == "__main__":
    main()
