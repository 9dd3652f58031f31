"""Constructed keypoints and matches with known truth, for the tests of matching, consensus and verdict."""

from __future__ import annotations

import numpy as np

from planish.geometry import exp_se3, exp_so3, transform_points
from planish.registration.keypoints.keypoints import Keypoints
from planish.registration.match.descriptors import nearest_neighbours
from planish.registration.matches import Matches

T_TRUE = exp_se3([0.1, -0.2, 1.9, 40, -20, 10])


def frames(rng, n, normal_rad=0.0, directions=None):
    """Frames (n, 3, 3) of a nearly flat surface facing -z: any orientation, or one of `directions` [rad]."""
    angles = rng.uniform(-np.pi, np.pi, n) if directions is None else rng.choice(directions, n)
    turned = [exp_so3([0, 0, angle]) for angle in angles]
    tilted = [exp_so3([*tilt, 0]) for tilt in normal_rad * rng.standard_normal((n, 2))]
    facing = np.diag([1.0, -1.0, -1.0])
    return np.array([tilt @ facing @ turn for tilt, turn in zip(tilted, turned, strict=True)]).reshape(-1, 3, 3)


def places(rng, n, extent_mm=(300.0, 250.0), bend=1 / 3000):
    """Points (n, 3) on a slightly bent sheet [mm]."""
    xy = rng.uniform(-0.5, 0.5, (n, 2)) * extent_mm
    return np.column_stack([xy, (xy**2).sum(1) * bend])


def keypoints(points, frames_sensor, rng):
    n = len(points)
    return Keypoints(
        np.asarray(points, float), np.asarray(frames_sensor, float), np.full(n, 5.0), rng.uniform(0, 1000, (n, 2)),
        rng.integers(0, 256, (n, 128)).astype(np.uint8), np.zeros(n, np.intp), rng.uniform(0, 1000, (n, 2)),
        rng.uniform(-np.pi, np.pi, n),
    )  # fmt: skip


def random_side(rng, n, extent_mm=(300.0, 250.0)):
    return keypoints(places(rng, n, extent_mm), frames(rng, n, 0.05), rng)


def plate_side(rng, n, directions=None):
    """A plate: all normals equal but for their noise; orientations any or, as on brushed metal, of few directions."""
    return keypoints(places(rng, n, bend=0.0), frames(rng, n, 0.01, directions), rng)


def pair(rng, total, groups=((0, T_TRUE),), noise_mm=0.2, turn_rad=0.03, side=random_side):
    """Keypoints of a and b and `total` matches, of which the first ones agree: (number, T_a_b) per group, in order."""
    b = side(rng, total)
    a = side(rng, total)
    points_a, frames_a = a.points_sensor.copy(), a.frames_sensor.copy()
    start = 0
    for number, T in groups:
        one = slice(start, start + number)
        points_a[one] = transform_points(T, b.points_sensor[one]) + noise_mm * rng.standard_normal((number, 3))
        turns = np.array([exp_so3([0, 0, x]) for x in turn_rad * rng.standard_normal(number)]).reshape(-1, 3, 3)
        frames_a[one] = T[:3, :3] @ b.frames_sensor[one] @ turns
        start += number
    a = keypoints(points_a, frames_a, rng)
    return a, b, matches_of(a, b)


def matches_of(a, b):
    """Each keypoint of a with that of the same number in b."""
    return Matches(
        a.points_sensor, b.points_sensor, a.frames_sensor, b.frames_sensor, a.pixels, b.pixels, np.full(len(a), np.nan)
    )


def by_descriptors(a, b, max_ratio=0.95):
    """Mutual nearest neighbours of the descriptors, where the keypoints stand: nothing is aligned."""
    near = nearest_neighbours(a, b, 1.4, len(a) + len(b), 1)
    good = near.mutual & (near.ratio <= max_ratio)
    return matches_of(a.take(near.index_a[good]), b.take(near.index_b[good]))


def shuffled(rng, matches):
    return matches.take(rng.permutation(len(matches)))
