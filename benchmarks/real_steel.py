"""Left against right camera of one real capture of brushed steel: the transform is the calibration.

    python benchmarks/real_steel.py

Two measurements of shared/data/steel_corner_shiftline, organised on either camera with its own images as the only
texture: as they are, cropped so that they share less, and with another lamp imitated on one of them: its brightness
multiplied by a ramp 1 : 4 and an offset added. Then both halves of the texture are compared with each other.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from planish.geometry import Array, invert, rotation_angle, transform_points
from planish.measurement import Measurement, View, rejection_bit
from planish.pipeline import MeasureOptions, measure, register
from planish.sensing.capture.manifest import Capture
from real_steel_halves import halves_table
from render_tables import ROOT, save_table

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


def errors(left: Measurement, right: Measurement, T_true: Array) -> dict[str, Any]:
    """Return what registration says of two measurements, and its errors at the overlap's centroid."""
    pair = register([left, right]).pair("left", "right")
    row: dict[str, Any] = {
        "status": pair.status, "places": pair.consensus, "alarms": pair.log10_false_alarms, "reason": pair.reason
    }  # fmt: skip
    if pair.T_a_b is not None and pair.covariance_point_mm is not None:
        centre = transform_points(invert(pair.T_a_b), pair.covariance_point_mm)
        row["deg"] = float(np.rad2deg(rotation_angle(invert(T_true) @ pair.T_a_b)))
        row["mm"] = float(np.linalg.norm(transform_points(T_true, centre) - pair.covariance_point_mm))
    return row


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    capture = Capture.load(MANIFEST, DATA)
    left = replace(measure(capture, MeasureOptions(organise_on="A", texture_views=("A",))), name="left")
    right = replace(measure(capture, MeasureOptions(organise_on="B", texture_views=("B",))), name="right")
    T_true = invert(left.rig.cameras["B"].T_camera_sensor)
    cropped = crop(left, LEFT_COLUMNS), crop(right, RIGHT_COLUMNS)
    rows = [
        {"what": "full"} | errors(left, right, T_true),
        {"what": "cropped"} | errors(*cropped, T_true),
        {"what": "full, another lamp on the right one"} | errors(left, other_lamp(right), T_true),
        {"what": "cropped, another lamp on the right one"} | errors(cropped[0], other_lamp(cropped[1]), T_true),
    ]
    print(*rows, sep="\n")
    columns = {
        "what": "left against right", "status": "status", "places": "distinct places",
        "alarms": "log10 false alarms", "deg": "rotation error [deg]", "mm": "at the centroid [mm]",
    }  # fmt: skip
    formats = {"alarms": ".0f", "deg": ".4f", "mm": ".3f"}
    rows = [{key: row.get(key) for key in columns} for row in rows]
    save_table("real-steel", columns, rows, "python benchmarks/real_steel.py", formats)
    halves_table(left, right)


if __name__ == "__main__":
    main()
