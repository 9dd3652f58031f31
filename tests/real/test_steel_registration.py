"""Two measurements of one capture, organised on the left and on the right camera, each with its own texture only.

Their transform is the calibration. (They share one triangulation: this tests texture and transform, not geometry.)
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planish.geometry import invert, rotation_angle, transform_points
from planish.pipeline import MeasureOptions, measure, register
from planish.rig.exchange.opencv import read_opencv_rig
from planish.sensing.capture.manifest import Capture

IMAGES = Path(__file__).resolve().parents[3] / "shared" / "data" / "steel_corner_shiftline"
MANIFEST = Path(__file__).parent / "steel_corner_shiftline" / "capture.json"

#: The issue's limits for the transform at the overlap's centroid.
ROTATION_DEG, POSITION_MM = 0.05, 0.7

pytestmark = pytest.mark.skipif(not IMAGES.is_dir(), reason=f"real captures are not here: {IMAGES}")


def test_left_against_right_gives_the_calibration():
    capture = Capture.load(MANIFEST, IMAGES)
    left = replace(measure(capture, MeasureOptions(organise_on="A", texture_views=("A",))), name="left")
    right = replace(measure(capture, MeasureOptions(organise_on="B", texture_views=("B",))), name="right")
    pair = register([left, right]).pair("left", "right")
    assert pair.status == "accepted", pair.reason
    rig = read_opencv_rig([IMAGES / "intrinsic.yml", IMAGES / "extrinsic.yml"], (2048, 1536)).rig
    T_true = invert(rig.cameras["B"].T_camera_sensor)
    centre = transform_points(invert(pair.T_a_b), pair.covariance_point_mm)
    assert np.rad2deg(rotation_angle(invert(T_true) @ pair.T_a_b)) <= ROTATION_DEG
    assert np.linalg.norm(transform_points(T_true, centre) - pair.covariance_point_mm) <= POSITION_MM
