"""Do disjoint halves of a real texture say the same, within noise and calibration?

The left camera's texture is cut in two, each half is registered against the right camera's: no pixel of the left one
is in both, and no place of the right one. Both measurements are of one rig, whose errors are shared. Its calibration
states no covariance: it gets that of a calibration by 20 boards, scaled to the row errors that it is known to have.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from planish.geometry import Array, adjoint, difference, move_covariance, transform_points, translation
from planish.measurement import Measurement, rejection_bit
from planish.pipeline import register
from planish.registration.result import PairResult
from planish.rig import Rig
from render_tables import ROOT, save_table

sys.path.append(str(ROOT / "tests"))
from calibrated_rig import with_calibration

#: Rms distance of corresponding pixels from the epipolar lines of the calibration that came with the images [px].
ROW_ERROR_PX = 0.75
#: Edge of a tile where halves are interleaved [mm].
TILE_MM = 20.0
#: Every so many pixels tell the row errors.
EVERY = 40

Mask = NDArray[np.bool_]


def halves_table(left: Measurement, right: Measurement) -> None:
    """Register both halves of each cut, save the table `real-steel-halves` and print it.

    Both measurements are in one frame and have a rig that states its errors (`stated_rig`).
    """
    rows = []
    for what, first in cuts(left).items():
        pairs = [register([kept(left, mask), right]).pair("left", "right") for mask in (first, ~first)]
        rows.append({"what": what} | compared(*pairs))
        print(rows[-1], flush=True)
    columns = {
        "what": "the left texture cut into", "status": "status", "deg": "apart [deg]", "mm": "at the centroid [mm]",
        "noise_mm": "by noise, sigma [mm]", "calibration_mm": "by calibration, sigma [mm]",
        "noise": "square / 6, noise alone", "total": "noise and calibration", "inside": "within 95 %",
    }  # fmt: skip
    formats = dict.fromkeys(("deg", "mm", "noise_mm", "calibration_mm"), ".4f") | {"noise": ".2f", "total": ".2f"}
    save_table("real-steel-halves", columns, rows, "python benchmarks/real_steel.py", formats)


def cuts(m: Measurement) -> dict[str, Mask]:
    """Return masks (H, W) of the first of two halves."""
    v, u = np.nonzero(m.valid)
    rows, columns = np.indices(m.shape)
    tile = max(1, round(TILE_MM / m.sample_distance_mm))
    return {
        "left and right half": columns < np.median(u),
        "upper and lower half": rows < np.median(v),
        f"tiles of {TILE_MM:g} mm in turn": (rows // tile + columns // tile) % 2 == 0,
    }


def kept(m: Measurement, mask: Mask) -> Measurement:
    """Return the measurement without points outside a mask (H, W)."""
    points, sigma, rejected = m.points_sensor.copy(), m.sigma_mm.copy(), m.rejected.copy()
    points[~mask], sigma[~mask] = np.nan, np.nan
    rejected[~mask] |= rejection_bit("masked")
    return replace(m, points_sensor=points, sigma_mm=sigma, rejected=rejected)


def compared(first: PairResult, second: PairResult) -> dict[str, Any]:
    """Return by how much two halves differ, and by how much they may."""
    if first.T_a_b is None or second.T_a_b is None:
        return {"status": " / ".join(f"{p.status}: {p.reason}" for p in (first, second))}
    centre = 0.5 * (first.covariance_point_mm + second.covariance_point_mm)
    d = difference(first.T_a_b, second.T_a_b, centre)
    noise, shifts = np.zeros((6, 6)), []
    for pair in (first, second):
        noise += move_covariance(pair.covariance_noise, pair.covariance_point_mm, centre)
        (xi,) = (pair.calibration_shifts or {}).values()
        shifts.append(xi @ adjoint(translation(pair.covariance_point_mm - centre)).T)
    apart = shifts[0] - shifts[1]
    calibration = apart.T @ apart
    squares = [float(d @ np.linalg.solve(C, d)) / 6 for C in (noise, noise + calibration)]
    return {
        "status": "accepted", "deg": float(np.rad2deg(np.linalg.norm(d[:3]))), "mm": float(np.linalg.norm(d[3:])),
        "noise_mm": float(np.sqrt(np.trace(noise[3:, 3:]))), "noise": squares[0], "total": squares[1],
        "calibration_mm": float(np.sqrt(np.trace(calibration[3:, 3:]))),
        "inside": "yes" if 6 * squares[1] < chi2.ppf(0.95, 6) else "no",
    }  # fmt: skip


def stated_rig(m: Measurement) -> Rig:
    """Return the rig with a covariance that expects its row errors."""
    rig = with_calibration(m.rig)
    assert rig.covariance is not None
    factor = ROW_ERROR_PX / expected_row_error_px(m, rig)
    return replace(rig, covariance=factor**2 * rig.covariance)


def expected_row_error_px(m: Measurement, rig: Rig) -> float:
    """Return the rms distance of B's pixels from the epipolar lines of A's that the rig's covariance expects [px]."""
    v, u = (x[::EVERY] for x in np.nonzero(m.valid))
    points = m.points_sensor[v, u].astype(float)
    pixels_a, pixels_b = (rig.cameras[name].project(points) for name in "AB")
    squares = sum(row_errors_px(rig.changed(mode), points, pixels_a, pixels_b) ** 2 for mode in rig.modes())
    return float(np.sqrt(np.mean(squares)))


def row_errors_px(rig: Rig, points: Array, pixels_a: Array, pixels_b: Array) -> Array:
    """Return the distances (N,) of B's pixels from the epipolar lines of A's pixels, drawn near the points [px]."""
    a, b = rig.cameras["A"], rig.cameras["B"]
    rays = a.rays_sensor(pixels_a)
    depth = transform_points(a.T_camera_sensor, points)[:, 2:]
    near, far = (b.project(a.center_sensor + rays * depth * factor) for factor in (0.98, 1.02))
    along = (far - near) / np.linalg.norm(far - near, axis=1, keepdims=True)
    off = pixels_b - near
    return np.asarray(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0])
