"""NumPy twin of the consensus: which matches agree with a transform, and the best transform of all pairs of matches."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from planish.geometry import compose, nearest_rotation


def agreeing(T_a_b, points_a, points_b, frames_a, frames_b, tolerance_mm, normal_angle_rad, frame_angle_rad=np.pi):
    """Indices of the matches that agree in position, normal and (if asked for) orientation."""
    found = []
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    for m in range(len(points_a)):
        if np.linalg.norm(R @ points_b[m] + t - points_a[m]) > tolerance_mm:
            continue
        angles = [np.arccos(np.clip(frames_a[m, :, i] @ R @ frames_b[m, :, i], -1, 1)) for i in (0, 2)]
        if angles[0] <= frame_angle_rad and angles[1] <= normal_angle_rad:
            found.append(m)
    return found


def cells(points_a, distinct_mm):
    """Number of cells of this size that hold a point."""
    return len({tuple(cell) for cell in np.floor(points_a / distinct_mm).astype(int)})


def places(points, distinct_mm):
    """Number of points at least so far from each that was counted before them."""
    counted = []
    for point in points:
        if all(np.linalg.norm(point - other) > distinct_mm for other in counted):
            counted.append(point)
    return len(counted)


def best_of_all_pairs(
    points_a, points_b, frames_a, frames_b, tolerance_mm, normal_angle_rad, frame_angle_rad, distinct_mm
):
    """Most places that agree with the rigid fit to two matches and their frames, over all pairs of matches."""
    best = 0
    weight = (tolerance_mm / frame_angle_rad) ** 2
    for pair in combinations(range(len(points_a)), 2):
        i = list(pair)
        a, b = points_a[i] - points_a[i].mean(0), points_b[i] - points_b[i].mean(0)
        R = nearest_rotation(a.T @ b + weight * np.einsum("mik,mjk->ij", frames_a[i], frames_b[i]))
        T = compose(R, points_a[i].mean(0) - R @ points_b[i].mean(0))
        members = agreeing(T, points_a, points_b, frames_a, frames_b, tolerance_mm, normal_angle_rad, frame_angle_rad)
        best = max(best, cells(points_a[members], distinct_mm))
    return best
