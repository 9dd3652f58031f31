"""Registers one pair of clouds with the peers; runs in their own environment (open3d, kiss-matcher).

    python coarse_peers.py pair.npz result.json

Writes per peer the transform (4, 4) from b to a.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import kiss_matcher
import numpy as np
import open3d as o3d

VOXEL_MM = 3.0


def main() -> None:
    data = np.load(sys.argv[1])
    clouds = {}
    for name in ("a", "b"):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(data[name].astype(float)))
        cloud = cloud.voxel_down_sample(VOXEL_MM)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * VOXEL_MM, 30))
        cloud.orient_normals_towards_camera_location([0, 0, 1000.0])
        clouds[name] = cloud
    a, b = clouds["a"], clouds["b"]
    register = o3d.pipelines.registration
    search = o3d.geometry.KDTreeSearchParamHybrid(5 * VOXEL_MM, 100)
    fa, fb = (register.compute_fpfh_feature(c, search) for c in (a, b))
    o3d.utility.random.seed(0)
    ransac = register.registration_ransac_based_on_feature_matching(
        b, a, fb, fa, True, 1.5 * VOXEL_MM, register.TransformationEstimationPointToPoint(False), 3,
        [
            register.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            register.CorrespondenceCheckerBasedOnDistance(1.5 * VOXEL_MM),
        ],
        register.RANSACConvergenceCriteria(100000, 0.999),
    )  # fmt: skip
    fast = register.registration_fgr_based_on_feature_matching(
        b, a, fb, fa, register.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * VOXEL_MM)
    )
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(VOXEL_MM))
    kiss = matcher.estimate(np.asarray(b.points), np.asarray(a.points))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.asarray(kiss.rotation), np.asarray(kiss.translation).ravel()
    found = {"fpfh_ransac": ransac.transformation, "fgr": fast.transformation, "kiss_matcher": T}
    Path(sys.argv[2]).write_text(json.dumps({name: np.asarray(item).tolist() for name, item in found.items()}))


if __name__ == "__main__":
    main()
