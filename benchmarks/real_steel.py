"""Left against right camera of one real capture of brushed steel: the transform is the calibration.

    python benchmarks/real_steel.py

Two measurements of shared/data/steel_corner_shiftline, organised on either camera with its own images as the only
texture: as they are, cropped so that they share less, and with another lamp imitated on one of them: its brightness
multiplied by a ramp 1 : 4 and an offset added. Then both halves of the texture are compared with each other, and what
distances and textures say alone.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from planish.geometry import difference, invert, transform_points
from planish.measurement import Measurement, View, rejection_bit
from planish.pipeline import MeasureOptions, measure, register
from planish.sensing.capture.manifest import Capture
from render_tables import ROOT, save_table
from steel.halves import halves_table, stated_rig
from steel.sources import sources_table

DATA = ROOT.parent / "shared" / "data" / "steel_corner_shiftline"
MANIFEST = ROOT / "tests" / "real" / "steel_corner_shiftline" / "capture.json"
#: Columns that are kept of each camera when cropped.
LEFT_COLUMNS, RIGHT_COLUMNS = slice(None, 1250), slice(650, None)
#: The lamp: factors at the first and the last column, and offset [grey levels].
RAMP, OFFSET = (0.5, 2.0), 15.0


def crop(m: Measurement, columns: slice) -> Measurement:
    """Return the measurement without points outside the columns."""
    outside = np.ones(m.shape, bool)
    outside[:, columns] = False
    points, sigma, rejected = m.points_sensor.copy(), m.sigma_mm.copy(), m.rejected.copy()
    points[outside], sigma[outside] = np.nan, np.nan
    rejected[outside] |= rejection_bit("masked")
    return replace(m, points_sensor=points, sigma_mm=sigma, rejected=rejected)


def other_lamp(m: Measurement) -> Measurement:
    """Return the measurement as if another lamp had lit it."""
    ramp = np.linspace(*RAMP, m.shape[1], dtype=np.float32)

    def lit(view: View) -> View:
        images = {
            name: None if getattr(view, name) is None else getattr(view, name) * ramp + np.float32(offset)
            for name, offset in (("white", OFFSET), ("mean", OFFSET), ("modulation", 0.0))
        }
        # What was saturated stays so, and nothing else is: the offset came after the sensor.
        return replace(view, **images, saturation=float("inf"))

    return replace(m, views={name: lit(view) for name, view in m.views.items()})


def errors(left: Measurement, right: Measurement) -> dict[str, Any]:
    """Return what registration says of two measurements in one frame, and its errors at the overlap's centroid."""
    pair = register([left, right]).pair("left", "right")
    row: dict[str, Any] = {
        "status": pair.status, "places": pair.consensus, "alarms": pair.log10_false_alarms, "reason": pair.reason
    }  # fmt: skip
    if pair.T_a_b is not None and pair.covariance_point_mm is not None:
        xi = difference(np.eye(4), pair.T_a_b, pair.covariance_point_mm)
        row |= {"deg": float(np.rad2deg(np.linalg.norm(xi[:3]))), "mm": float(np.linalg.norm(xi[3:]))}
        assert pair.covariance_noise is not None
        assert pair.covariance_calibration is not None
        total = pair.covariance_noise + pair.covariance_calibration
        row |= {
            "sigma_mm": float(np.sqrt(np.trace(total[3:, 3:]))),
            "total": float(xi @ np.linalg.solve(total, xi)) / 6,
        }
    return row


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    capture = Capture.load(MANIFEST, DATA)
    left = replace(measure(capture, MeasureOptions(organise_on="A", texture_views=("A",))), name="left")
    right = replace(measure(capture, MeasureOptions(organise_on="B", texture_views=("B",))), name="right")
    # Both in the left camera's frame: the truth is that nothing moved.
    points = np.asarray(
        transform_points(invert(left.rig.cameras["B"].T_camera_sensor), right.points_sensor), np.float32
    )
    rig = stated_rig(left)
    left, right = replace(left, rig=rig), replace(right, rig=rig, points_sensor=points)
    cropped = crop(left, LEFT_COLUMNS), crop(right, RIGHT_COLUMNS)
    rows = [
        {"what": "full"} | errors(left, right),
        {"what": "cropped"} | errors(*cropped),
        {"what": "full, another lamp on the right one"} | errors(left, other_lamp(right)),
        {"what": "cropped, another lamp on the right one"} | errors(cropped[0], other_lamp(cropped[1])),
    ]
    print(*rows, sep="\n")
    columns = {
        "what": "left against right", "status": "status", "places": "distinct places",
        "alarms": "log10 false alarms", "deg": "rotation error [deg]", "mm": "at the centroid [mm]",
        "sigma_mm": "stated sigma, noise and calibration [mm]", "total": "square / 6",
    }  # fmt: skip
    formats = {"alarms": ".0f", "deg": ".4f", "mm": ".3f", "sigma_mm": ".3f", "total": ".2f"}
    rows = [{key: row.get(key) for key in columns} for row in rows]
    save_table("real-steel", columns, rows, "python benchmarks/real_steel.py", formats)
    halves_table(left, right)
    sources_table(left, right)


if __name__ == "__main__":
    main()
