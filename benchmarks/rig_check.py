"""`planish check-rig` on simulated captures: false alarms of intact rigs, and rigs whose orientation was changed.

python benchmarks/rig_check.py --seeds 21 22

Every capture is measured with each rig, checked; where it does not hold, adjusted, measured with the adjusted rig and
checked again. The projector's calibration is not given: two cameras alone. Errors are those along the organising
camera's ray against truth, rms.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from planish.geometry import Array
from planish.measurement import Measurement
from planish.pipeline import MeasureOptions, measure
from planish.pipeline.checking import CheckedRig, check_calibration
from planish.rig import Rig
from planish.rig.derivatives import project_with_derivatives
from planish.rig.parameters import selection
from planish.sensing.capture.manifest import Capture
from planish.sensing.rigcheck.orientation import CHANGES, orientation_basis, reoriented
from planish.simulation.render import trace_capture
from planish.simulation.scenes import Scene, make_scene
from planish.simulation.writing import write_scene
from render_tables import ROOT, save_table

SCENES = ("door", "plate", "cylinder")
SCALE = 0.5
ANGLES_DEG = (0.02, 0.1, 0.3)
#: Corners of boards behind the stated covariance, their noise [px], and the volume they fill [mm].
CORNERS, CORNER_PX, VOLUME_MM = 400, 0.05, (200.0, 150.0, 100.0)
FREE = ("fx", "fy", "cx", "cy", "k1", "k2")
EXTERNAL = ("rotation_x", "rotation_y", "rotation_z", "translation_x", "translation_y", "translation_z")


@dataclass
class Tally:
    """What the checks of one kind of rig said."""

    verdicts: list[str] = field(default_factory=list)
    found_px: list[float] = field(default_factory=list)
    z: list[float] = field(default_factory=list)
    unseen_mm: list[float] = field(default_factory=list)
    left_px: list[float] = field(default_factory=list)
    before_mm: list[float] = field(default_factory=list)
    after_mm: list[float] = field(default_factory=list)

    def row(self, case: str) -> dict[str, float | int | str | None]:
        """Return the row of the table."""

        def median(values: list[float]) -> float | None:
            return float(np.median(values)) if values else None

        return {
            "case": case,
            "checks": len(self.verdicts),
            **{name: self.verdicts.count(name) for name in ("holds", "does not hold", "not observable")},
            "found": median(self.found_px),
            "z": float(np.sqrt(np.mean(np.square(self.z)))) if self.z else None,
            "left": max(self.left_px) if self.left_px else None,
            "before": median(self.before_mm),
            "after": median(self.after_mm),
            "unseen": median(self.unseen_mm),
        }


def cameras_alone(rig: Rig) -> Rig:
    """Return the rig without its projector."""
    return replace(rig, projector=None)


def with_covariance(rig: Rig, rng: np.random.Generator) -> Rig:
    """Return the rig with the covariance of a calibration by boards whose places are known."""
    names = [f"{device}.{name}" for device in rig.cameras for name in FREE] + [f"B.{name}" for name in EXTERNAL]
    points = rng.uniform(-1, 1, (CORNERS, 3)) * VOLUME_MM
    picks = selection(names, tuple(rig.devices))
    rows = [project_with_derivatives(camera, points)[2] @ picks[name] for name, camera in rig.cameras.items()]
    J = np.concatenate(rows).reshape(-1, len(names)) / CORNER_PX
    return replace(rig, covariance=np.linalg.inv(J.T @ J), covariance_parameters=tuple(names))


def drawn(rig: Rig, rng: np.random.Generator) -> Rig:
    """Return a rig drawn from its covariance, which it states as its own."""
    modes = rig.modes()
    return rig.changed(rng.standard_normal(len(modes)) @ modes)


def measured(folder: Path, rig: Rig, organise_on: str = "A") -> Measurement:
    """Measure the capture with another rig."""
    rig.save(folder / "other.json")
    capture = Capture.load(folder)
    capture = replace(capture, manifest=capture.manifest.model_copy(update={"rig": "other.json"}))
    return measure(capture, MeasureOptions(organise_on=organise_on))


def ray_error_mm(item: Measurement, truth: Array) -> float:
    """Return the rms error along the rays."""
    both = item.valid & np.isfinite(truth[..., 2])
    ray = truth[both] - item.camera.center_sensor
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return float(np.sqrt(np.mean(((item.points_sensor[both] - truth[both]) * ray).sum(1) ** 2)))


def noted(tally: Tally, checked: CheckedRig) -> None:
    """Add a verdict."""
    check = checked.check
    tally.verdicts.append(check.status)
    if check.rms_px is not None and check.mean_px is not None and check.sigma_px and check.orientation is not None:
        tally.found_px.append(float(np.hypot(check.mean_px, check.variation_px or 0.0)))
        tally.z.append(check.mean_px / check.sigma_px)
        tally.unseen_mm.append(check.orientation.unseen_mm)


def parts(item: Measurement) -> Iterator[Measurement]:
    """Yield a measurement, and with one half of the image only."""
    yield item
    for half in (slice(None, item.shape[1] // 2), slice(item.shape[1] // 2, None)):
        pixels = item.correspondence_px.copy()
        pixels[:, half] = np.nan
        yield replace(item, correspondence_px=pixels)


def captures(seeds: Sequence[int], folder: Path) -> Iterator[tuple[Scene, int, Path]]:
    """Render two captures of each scene and seed."""
    for name in SCENES:
        for seed in seeds:
            scene = make_scene(name, seed, 2, scale=SCALE)
            paths = write_scene(scene, folder / f"{name}{seed}", true_points=False)
            yield from ((scene, index, path) for index, path in enumerate(paths))


def changed_rigs(rig: Rig, rng: np.random.Generator) -> Iterator[tuple[str, Rig]]:
    """Yield rigs with another relative orientation."""
    basis = orientation_basis(rig, "B", "A")
    for k, name in enumerate(CHANGES):
        for angle in ANGLES_DEG:
            yield f"{name}, {angle} deg", reoriented(rig, "B", "A", basis[:, k] * np.deg2rad(angle))
    for angle in ANGLES_DEG[1:]:
        drawn_rad = np.deg2rad(angle) * rng.standard_normal(len(CHANGES))
        yield f"all five drawn, {angle} deg", reoriented(rig, "B", "A", basis @ drawn_rad)


def run(seeds: Sequence[int]) -> list[dict[str, float | int | str | None]]:
    """Return the rows of the table."""
    tallies: dict[str, Tally] = {}
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as place:
        for scene, index, folder in captures(seeds, Path(place)):
            true, truth = cameras_alone(scene.rig), trace_capture(scene, index, "A")[0]
            for camera in ("A", "B"):
                for item in parts(measured(folder, true, camera)):
                    noted(tallies.setdefault("intact", Tally()), check_calibration({"m": item}))
            stated = with_covariance(true, rng)
            for _ in range(2):
                item = measured(folder, drawn(stated, rng))
                noted(
                    tallies.setdefault("drawn from the covariance it states", Tally()), check_calibration({"m": item})
                )
            for case, rig in changed_rigs(true, rng) if index == 0 else ():
                tally = tallies.setdefault(case, Tally())
                item = measured(folder, rig)
                checked = check_calibration({"m": item}, adjust=True)
                noted(tally, checked)
                if checked.adjustment is None or checked.adjustment.refusal:
                    continue
                again = measured(folder, checked.adjustment.rig)
                left = check_calibration({"m": again}).check
                tally.left_px.append(float(left.rms_px or 0.0))
                tally.before_mm.append(ray_error_mm(item, truth))
                tally.after_mm.append(ray_error_mm(again, truth))
            print(folder.parent.name, folder.name, flush=True)
    return [tally.row(case) for case, tally in tallies.items()]


def real_rows() -> list[dict[str, float | int | str | None]]:
    """Return the real captures as they are and, where it is adjusted, by the adjusted rig."""
    sys.path.extend([str(ROOT / "tests"), str(ROOT / "tests" / "real")])
    from captures import HERE, load, plane_spread
    from test_steel import PATCHES

    from points import ball_form

    if not (HERE.parents[2] / "shared" / "data").is_dir():
        return []
    rows: list[dict[str, float | int | str | None]] = []
    for name in ("steel_corner_shiftline", "ball_12step"):
        capture, rig = load(name), None
        for what in ("as calibrated", "adjusted"):
            item = measure(capture, None, None, rig)
            checked = check_calibration({"m": item}, adjust=True)
            c = checked.check
            row = {"what": f"{name}, {what}", "mean": c.mean_px, "rms": c.rms_px, "lens": c.unexplained_px,
                   "points": int(item.valid.sum())}  # fmt: skip
            if name.startswith("steel"):
                for patch, ((u0, u1), (v0, v1), _, _) in PATCHES.items():
                    row[patch] = plane_spread(item.points_sensor[v0:v1, u0:u1][item.valid[v0:v1, u0:u1]])
            else:
                row["ball"] = ball_form(item)["sigma"]
            rows.append(row)
            if checked.adjustment is None or checked.adjustment.refusal:
                break
            rig = checked.adjustment.rig
    return rows


def save_real(rows: list[dict[str, float | int | str | None]], command: str) -> None:
    """Save the table of the real captures."""
    columns = {"what": "capture", "mean": "mean row error [px]", "rms": "rms over the image [px]",
               "lens": "of it no orientation's [px]", "points": "points", "floor": "floor: plane [mm]",
               "right wall, upper": "right wall, upper [mm]", "right wall, right": "right wall, right [mm]",
               "ball": "disc: sphere [mm]"}  # fmt: skip
    plane = dict.fromkeys(("floor", "right wall, upper", "right wall, right", "ball"), ".4f")
    save_table("rig-check-real", columns, rows, command,
               {"mean": "+.3f", "rms": ".3f", "lens": ".3f", "points": ",d", **plane})  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22])
    parser.add_argument("--real", action="store_true", help="the real captures alone")
    given = parser.parse_args()
    command = "python benchmarks/rig_check.py --seeds " + " ".join(map(str, given.seeds))
    real = real_rows()
    if real:
        save_real(real, command)
    if given.real:
        return
    rows = run(given.seeds)
    for row in rows:
        print({key: f"{value:.3g}" if isinstance(value, float) else value for key, value in row.items()})
    columns = {"case": "rig", "checks": "checks", "holds": "holds", "does not hold": "does not hold",
               "not observable": "not observable", "found": "row error found [px]", "z": "mean row error / sigma, rms",
               "left": "largest row error after adjusting [px]", "before": "error along the ray before [mm]",
               "after": "after [mm]", "unseen": "what row errors leave unknown [mm]"}  # fmt: skip
    save_table("rig-check", columns, rows, command,
               {"found": ".3f", "z": ".2f", "left": ".3f", "before": ".3f", "after": ".3f",
                "unseen": ".2f"})  # fmt: skip


if __name__ == "__main__":
    main()
