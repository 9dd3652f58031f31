"""Keypoints and descriptors against each other, on the same texture images: right places for the same number.

    python benchmarks/descriptors.py
    python benchmarks/descriptors.py --keep FOLDER     (keeps the measurements there, or takes them from there)

AKAZE needs opencv-contrib-python-headless: an environment of its own, or its folder in PYTHONPATH.

Every detector gives at most as many keypoints as planish does by default. Mutual nearest neighbours whose ratio to the
second is below 0.95 are matches. A match is right where its points lie within 1 mm of each other (at a ground sample
distance of 0.33 mm, in proportion at others) and its orientations within 20 degrees, for that is what the consensus
asks; right matches closer than 2 mm are one place. Times are those of one thread.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median
from typing import Any

import cv2
import numpy as np

from planish.geometry import Array, exp_so3, invert, transform_points
from planish.measurement import Measurement
from planish.pipeline import measure
from planish.registration.consensus import ConsensusOptions, count_places
from planish.registration.keypoints.detect import KeypointOptions
from planish.registration.scales import common_gsd, common_pitch, length_factor
from planish.registration.surface import fit_surface
from planish.registration.texture.charts import plan_charts
from planish.registration.texture.fixed_pattern import estimate_fixed_patterns
from planish.registration.texture.photometric import local_contrast
from planish.registration.texture.resample import TextureImage, texture_images
from planish.sensing.capture.manifest import Capture
from planish.simulation.scenes import Scene, make_scene
from planish.simulation.texture import Grain
from planish.simulation.writing import write_scene
from render_tables import save_table
from shared.described import DETECTORS, Found, mutual_matches

#: Correlation length of the isotropic grain [mm].
ISOTROPIC_MM = 0.4
#: The second sensor is turned about its axis by this much more with every seed [deg].
TURN_DEG = 137.0


@dataclass(frozen=True)
class Group:
    """Pairs of one kind of texture: surfaces x seeds."""

    name: str
    surfaces: tuple[str, ...]
    grain: float
    density: float
    isotropic: bool = False
    scale: float = 1.0


FLAT, ALL = ("plate", "cylinder"), ("door", "plate", "cylinder", "pipe", "waves")
GROUPS = (
    *(Group(f"brushed {100 * c:g} %", FLAT, c, 0.0) for c in (0.01, 0.005, 0.0025, 0.00125)),
    *(Group(f"isotropic {100 * c:g} %", FLAT, c, 0.0, isotropic=True) for c in (0.01, 0.005, 0.0025)),
    Group("marks alone", ("plate", "door"), 0.0, 1.0),
    Group("ordinary, half resolution", ALL, 0.01, 0.5, scale=0.5),
)


@dataclass(frozen=True)
class Pair:
    """Texture images of both measurements, the truth, and the lengths' factor of `PairOptions`."""

    a: tuple[TextureImage, ...]
    b: tuple[TextureImage, ...]
    T_a_b: Array
    factor: float


def scene_of(group: Group, surface: str, seed: int) -> Scene:
    """Return a scene of two captures that overlap by about 40 %, the second turned."""
    scene = make_scene(surface, seed, 2, grain=group.grain, texture_density=group.density, scale=group.scale)
    if group.isotropic:
        scene = replace(scene, texture=replace(scene.texture, grain=Grain(group.grain, ISOTROPIC_MM, ISOTROPIC_MM)))
    T_a, T_b = scene.T_object_sensor
    turn = np.eye(4)
    turn[:3, :3] = exp_so3([0, 0, np.deg2rad(TURN_DEG * seed)])
    return scene.seen_from([T_a, T_b @ turn])


def load_pair(group: Group, surface: str, seed: int, keep: Path | None) -> Pair:
    """Return a pair, rendered and measured, or as it was kept."""
    scene = scene_of(group, surface, seed)
    name = f"{group.name}-{surface}-{seed}".replace(" ", "_").replace(",", "").replace("%", "pc")
    files = [keep / f"{name}_{side}.h5" for side in "ab"] if keep else []
    if files and all(f.is_file() for f in files):
        a, b = (Measurement.load(f) for f in files)
    else:
        with tempfile.TemporaryDirectory() as folder:
            a, b = (measure(Capture.load(c)) for c in write_scene(scene, Path(folder), true_points=False))
        for m, f in zip((a, b), files, strict=False):
            m.save(f)
    pitch = common_pitch([a, b])
    fixed, images = estimate_fixed_patterns([a, b]), []
    for m in (a, b):
        fitted = fit_surface(m)
        contrast = local_contrast(m, None, fitted, fixed.get(m.name))
        images.append(texture_images(m, fitted, contrast, pitch, plan_charts(m, fitted)))
    T = invert(scene.T_object_sensor[0]) @ scene.T_object_sensor[1]
    return Pair(images[0], images[1], T, length_factor(common_gsd([a, b])))


def judge(pair: Pair, a: Found, b: Found) -> dict[str, float]:
    """Return matches, right places and the time of matching of two keypoint sets."""
    start = time.thread_time()
    index_a, index_b = mutual_matches(a, b)
    seconds = time.thread_time() - start
    x, y = a.keypoints.take(index_a), b.keypoints.take(index_b)
    distance = np.linalg.norm(x.points_sensor - transform_points(pair.T_a_b, y.points_sensor), axis=1)
    turned = y.frames_sensor[:, :, 0] @ pair.T_a_b[:3, :3].T
    cosine = (x.frames_sensor[:, :, 0] * turned).sum(1)
    asked = ConsensusOptions()
    right = (distance < asked.tolerance_mm * pair.factor) & (cosine > np.cos(asked.frame_angle_rad))
    places = count_places(x.points_sensor[right], asked.distinct_mm * pair.factor)
    return {"matches": len(index_a), "right": int(right.sum()), "places": places, "match_s": seconds}


def run_pair(group: Group, surface: str, seed: int, keep: Path | None) -> list[dict[str, Any]]:
    """Return one record per detector."""
    pair = load_pair(group, surface, seed, keep)
    count, rows = KeypointOptions().max_keypoints, []
    for name, detect in DETECTORS.items():
        start = time.thread_time()
        a, b = detect(pair.a, count), detect(pair.b, count)
        seconds = 0.5 * (time.thread_time() - start)
        found = judge(pair, a, b)
        found |= {"keypoints": (len(a.keypoints) + len(b.keypoints)) / 2, "detect_s": seconds}
        rows.append({"group": group.name, "surface": surface, "seed": seed, "detector": name, **found})
    return rows


def table_rows(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per detector: per group the median of the right places and the share of right matches."""
    rows = []
    full = {g.name for g in GROUPS if g.scale == 1}
    for name in DETECTORS:
        own = [r for r in records if r["detector"] == name]
        row: dict[str, Any] = {"detector": name}
        for group in GROUPS:
            of = [r for r in own if r["group"] == group.name]
            matches = sum(r["matches"] for r in of)
            share = sum(r["right"] for r in of) / matches if matches else 0.0
            row[group.name] = f"{median(r['places'] for r in of):.0f} ({100 * share:.0f} %)"
        row["keypoints"] = mean(r["keypoints"] for r in own if r["group"] in full)
        row |= {key: mean(r[key] for r in own if r["group"] in full) for key in ("detect_s", "match_s")}
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--keep", type=Path, help="folder of the measurements")
    arguments = parser.parse_args()
    os.environ["PLANISH_THREADS"] = "1"
    cv2.setNumThreads(1)
    if arguments.keep:
        arguments.keep.mkdir(parents=True, exist_ok=True)
    records = []
    for group in GROUPS:
        for surface in group.surfaces:
            for seed in arguments.seeds:
                records += run_pair(group, surface, seed, arguments.keep)
                print(group.name, surface, seed, {r["detector"]: r["places"] for r in records[-len(DETECTORS) :]})
    columns = {"detector": "detector, descriptor", **{g.name: g.name for g in GROUPS}}
    columns |= {"keypoints": "keypoints", "detect_s": "keypoints [s]", "match_s": "matching [s]"}
    seeds = " ".join(map(str, arguments.seeds))
    save_table(
        "descriptors", columns, table_rows(records), f"python benchmarks/descriptors.py --seeds {seeds}",
        {"keypoints": ".0f", "detect_s": ".3f", "match_s": ".3f"},
    )  # fmt: skip


if __name__ == "__main__":
    main()
