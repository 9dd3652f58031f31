"""NumPy twin of the count behind the consensus: which matches agree with a transform."""

from __future__ import annotations

import numpy as np


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
