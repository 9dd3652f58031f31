"""Points of single measurements against truth (simulated) and against form (real), without any spatial filter.

python benchmarks/points.py --seeds 1 2 3
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from planish.measurement import Measurement
from planish.pipeline import measure
from planish.sensing.capture.manifest import Capture
from planish.simulation.render import trace_capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from render_tables import ROOT, save_table

SCENES = ("door", "plate", "cylinder", "pipe", "waves")


def spread(values: np.ndarray) -> float:
    """Robust standard deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def simulated(name: str, seeds: list[int]) -> dict[str, float | int | str]:
    """Errors along the ray of the first capture of a scene, over all seeds."""
    errors, normalised, found, seen_by_all, points = [], [], 0, 0, 0
    for seed in seeds:
        scene = make_scene(name, seed, 1)
        with tempfile.TemporaryDirectory() as folder:
            write_scene(scene, Path(folder), true_points=False)
            item = measure(Capture.load(Path(folder) / "m1"))
        truth, seen = trace_capture(scene, 0, "A")
        both = item.valid & np.isfinite(truth[..., 2])
        ray = truth[both] - item.camera.center_sensor
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        error = ((item.points_sensor[both] - truth[both]) * ray).sum(1)
        errors.append(error)
        normalised.append(error / item.sigma_mm[both])
        found += int((item.valid & seen.astype(bool)).sum())
        seen_by_all += int(seen.astype(bool).sum())
        points += int(item.valid.sum())
    e, z = np.concatenate(errors), np.concatenate(normalised)
    return {
        "what": name,
        "seeds": len(seeds),
        "share": found / seen_by_all,
        "sigma": spread(e),
        "normalised": float(np.sqrt(np.mean(np.clip(z, -10, 10) ** 2))),
        "beyond": float((np.abs(e) > 0.5).mean()),
        "points": points,
    }


def real_rows() -> list[dict[str, float | int | str]]:
    """Form errors of the real captures, where they are present."""
    sys.path.extend([str(ROOT / "tests"), str(ROOT / "tests" / "real")])
    from captures import HERE, measured, plane_spread
    from test_steel import PATCHES

    if not (HERE.parents[2] / "shared" / "data").is_dir():
        return []
    steel = measured("steel_corner_shiftline")
    rows: list[dict[str, float | int | str]] = []
    for name, ((u0, u1), (v0, v1), _, known) in PATCHES.items():
        valid, points = steel.valid[v0:v1, u0:u1], steel.points_sensor[v0:v1, u0:u1]
        rows.append({"what": f"steel, {name}", "points": int(steel.valid.sum()), "share": float(valid.mean()),
                     "sigma": plane_spread(points[valid]), "known": known})  # fmt: skip
    ball = measured("ball_12step")
    rows.append({"what": "ball, disc", "points": int(ball.valid.sum()), **ball_form(ball), "known": 0.0082})
    return rows


def ball_form(ball: Measurement) -> dict[str, float]:
    """Share of valid pixels in the disc and robust spread of their distances from the best sphere."""
    v, u = np.indices(ball.shape)
    disc = (u - 930) ** 2 + (v - 601) ** 2 <= 350**2
    p = ball.points_sensor[disc & ball.valid].astype(float)
    origin, use = p.mean(0), np.ones(len(p), bool)
    for _ in range(5):
        x = p[use] - origin
        s = np.linalg.lstsq(np.column_stack([2 * x, np.ones(len(x))]), (x**2).sum(1), rcond=None)[0]
        r = np.linalg.norm(p - origin - s[:3], axis=1) - np.sqrt(s[3] + s[:3] @ s[:3])
        use = np.abs(r) < 6 * spread(r)
    return {"share": float(ball.valid[disc].mean()), "sigma": spread(r)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    seeds = parser.parse_args().seeds
    command = "python benchmarks/points.py --seeds " + " ".join(map(str, seeds))
    rows = []
    for name in SCENES:
        rows.append(simulated(name, seeds))
        print(rows[-1], flush=True)
    columns = {"what": "scene", "seeds": "seeds", "points": "points", "share": "of the pixels all three devices see",
               "sigma": "robust sigma along the ray [mm]", "normalised": "rms of error / sigma",
               "beyond": "beyond 0.5 mm"}  # fmt: skip
    save_table("points", columns, rows, command,
               {"share": ".2%", "sigma": ".4f", "normalised": ".3f", "beyond": ".1e", "points": ",d"})  # fmt: skip
    rows = real_rows()
    print(rows)
    if rows:
        columns = {"what": "capture", "points": "valid points", "share": "valid in the patch",
                   "sigma": "robust sigma of form [mm]", "known": "plain decoder [mm]"}  # fmt: skip
        save_table("points-real", columns, rows, command, {"share": ".2%", "sigma": ".4f", "points": ",d"})


if __name__ == "__main__":
    main()
