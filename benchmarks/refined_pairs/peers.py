"""Refines one pair of clouds with the peers; runs in their own environment (open3d, small_gicp).

    OMP_NUM_THREADS=2 python peers.py pair.npz result.json THREADS METHOD...

The input holds points (N, 3) [mm] of `a` and `b`, `contrast_*` and `white_*` (N,) from 0 to 1, `start` and `truth`
(4, 4) and `gsd` [mm per pixel]. Written is a list: method, settings, whether these are the recommended ones, transform,
seconds of preparation (thinning, normals) and of the refinement itself.

The search changes one setting after the other and keeps the best of each by the truth, which no user has.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import small_gicp

#: Recommended voxels in multiples of the sample distance, coarse to fine, and their iterations: Open3D's tutorial on
#: coloured registration thins clouds with points 6 mm apart to 40, 20 and 10 mm.
VOXELS, ITERATIONS = (6.7, 3.3, 1.7), (50, 30, 14)
#: The first settings are the recommended ones: Open3D's tutorial on coloured registration (gate of a voxel, weight of
#: the geometry); small_gicp's examples thin to 0.25 m, look 1 m (four voxels) far and at 10 neighbours. The others in
#: the order in which they are sought; 0 = all points.
ICP = {"gate": (1.0, 3.0), "finest": (1.7, 1.0, 0.0)}
COLOURED = {"texture": ("white", "contrast"), "weight": (0.968, 0.8, 0.5, 0.1)} | ICP
GICP = {"gate": (4.0, 2.0, 8.0), "neighbours": (10, 30), "thinned": (3.3, 1.7, 0.0)}

register = o3d.pipelines.registration
Row = dict[str, Any]


class Clouds:
    """Both clouds, thinned and with normals, once per voxel and texture, with the time that took."""

    def __init__(self, data: Any) -> None:
        self.data, self.known = data, {}

    def get(self, voxel: float, texture: str) -> tuple[list[Any], float]:
        """Return the clouds of a voxel [mm] (0 = all points) and the seconds that they took."""
        if (voxel, texture) not in self.known:
            started = time.perf_counter()
            clouds = [self._cloud(name, voxel, texture) for name in "ab"]
            self.known[voxel, texture] = clouds, time.perf_counter() - started
        return self.known[voxel, texture]

    def _cloud(self, name: str, voxel: float, texture: str) -> Any:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.data[name].astype(float)))
        grey = self.data[f"{texture}_{name}"].astype(float)
        cloud.colors = o3d.utility.Vector3dVector(np.repeat(grey[:, None], 3, 1))
        cloud = cloud.voxel_down_sample(voxel) if voxel > 0 else cloud
        reach = 2 * voxel if voxel > 0 else 4 * float(self.data["gsd"])
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(reach, 30))
        cloud.orient_normals_towards_camera_location([0, 0, 1000.0])
        return cloud


def multi_scale(clouds: Clouds, finest: float, gate: float, texture: str = "white", weight: float | None = None) -> Row:
    """Return the result of Open3D's coloured ICP over three voxels, without `weight` that of point-to-plane ICP."""
    gsd, T = float(clouds.data["gsd"]), np.array(clouds.data["start"])
    prepared = seconds = 0.0
    for factor, iterations in zip((*VOXELS[:2], finest), ITERATIONS, strict=True):
        (a, b), took = clouds.get(factor * gsd, texture)
        prepared += took
        distance = gate * max(factor, 1.0) * gsd
        criteria = register.ICPConvergenceCriteria(1e-6, 1e-6, iterations)
        started = time.perf_counter()
        if weight is not None:
            estimation = register.TransformationEstimationForColoredICP(weight)
            T = register.registration_colored_icp(b, a, distance, T, estimation, criteria).transformation
        else:
            estimation = register.TransformationEstimationPointToPlane()
            T = register.registration_icp(b, a, distance, T, estimation, criteria).transformation
        seconds += time.perf_counter() - started
    return {"T": np.asarray(T).tolist(), "prepared_s": prepared, "seconds": seconds}


def gicp(clouds: Clouds, thinned: float, neighbours: int, gate: float, threads: int) -> Row:
    """Return the result of small_gicp's GICP."""
    data, gsd = clouds.data, float(clouds.data["gsd"])
    started = time.perf_counter()
    sides = []
    for name in "ab":
        points = data[name].astype(float)
        if thinned > 0:
            cloud, tree = small_gicp.preprocess_points(points, thinned * gsd, neighbours, threads)
        else:
            cloud = small_gicp.PointCloud(points)
            tree = small_gicp.KdTree(cloud, threads)
            small_gicp.estimate_covariances(cloud, tree, neighbours, threads)
        sides.append((cloud, tree))
    prepared = time.perf_counter() - started
    (a, tree), (b, _) = sides
    started = time.perf_counter()
    result = small_gicp.align(
        a, b, tree, np.array(data["start"]), registration_type="GICP",
        max_correspondence_distance=gate * max(thinned, 1.0) * gsd, num_threads=threads, max_iterations=50,
        # In its own units these stand for metres; a millimetre's thousandth here.
        translation_epsilon=1e-4, rotation_epsilon=1e-6,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    return {"T": np.asarray(result.T_target_source).tolist(), "prepared_s": prepared, "seconds": seconds}


def error_mm(data: Any, T: Any) -> float:
    """Return how far a transform puts b from the truth, root mean square [mm]."""
    points = np.column_stack([data["b"][::97].astype(float), np.ones(len(data["b"][::97]))])
    return float(np.sqrt(((points @ (np.array(T) - data["truth"])[:3].T) ** 2).sum(1).mean()))


def search(data: Any, method: str, run: Callable[..., Row], settings: dict[str, tuple[Any, ...]]) -> Iterator[Row]:
    """Yield the results of the recommended settings and of those that follow by changing one after the other."""
    best = {name: values[0] for name, values in settings.items()}
    first = run(**best)
    least = error_mm(data, first["T"])
    yield {"method": method, "settings": dict(best), "recommended": True} | first
    for name, values in settings.items():
        for value in values[1:]:
            tried = best | {name: value}
            try:
                found = run(**tried)
            except RuntimeError:  # Open3D's answer to clouds that it has moved out of each other's reach
                continue
            yield {"method": method, "settings": tried, "recommended": False} | found
            if error_mm(data, found["T"]) < least:
                best, least = tried, error_mm(data, found["T"])


def main() -> None:
    data, threads = dict(np.load(sys.argv[1])), int(sys.argv[3])
    clouds, found = Clouds(data), []
    methods = {
        "coloured ICP": (partial(multi_scale, clouds), COLOURED),
        "point-to-plane ICP": (partial(multi_scale, clouds), ICP),
        "GICP": (partial(gicp, clouds, threads=threads), GICP),
    }
    for method in sys.argv[4:]:
        for row in search(data, method, *methods[method]):
            found.append(row)
            Path(sys.argv[2]).write_text(json.dumps(found))


if __name__ == "__main__":
    main()
