"""What the checks of the calibration say of the real captures, and what adjusting makes of them."""

import numpy as np
import pytest
from captures import load, measured, plane_spread
from test_steel import PATCHES

from planish.pipeline import measure
from planish.pipeline.checking import check_calibration

#: Row error that is left on the steel after adjusting and measuring again [px]: the lenses' part; before: 0.54 px.
LEFT_PX = 0.15


def test_the_rig_of_the_steel_does_not_hold_and_adjusting_takes_most_of_its_row_error():
    capture, before = load("steel_corner_shiftline"), measured("steel_corner_shiftline")
    found = check_calibration({"steel": before}, adjust=True)
    assert found.check.status == "does not hold"
    assert 0.3 < found.check.mean_px < 0.6
    # The lenses' part is told from the orientation's.
    assert found.check.unexplained_sigmas > 4
    assert any("calibrate again" in text for text in found.check.advice)
    after = measure(capture, None, 2, found.adjustment.rig)
    assert check_calibration({"steel": after}).check.rms_px < LEFT_PX
    assert after.valid.sum() >= before.valid.sum()
    for (u0, u1), (v0, v1), _, _ in PATCHES.values():
        spreads = [plane_spread(m.points_sensor[v0:v1, u0:u1][m.valid[v0:v1, u0:u1]]) for m in (before, after)]
        assert spreads[1] <= spreads[0]


def test_the_ball_shows_rows_off_by_many_pixels_that_no_orientation_explains():
    found = check_calibration({"ball": measured("ball_12step")}, adjust=True)
    assert found.check.status == "does not hold"
    (rows,) = found.check.measurements
    disc = np.hypot(*(rows.own_px - (930, 601)).T) < 300
    assert np.median(rows.error_px[disc]) == pytest.approx(-10, abs=3)
    assert "none that an orientation makes" in found.adjustment.refusal


def test_the_projector_of_the_board_does_not_hold_either():
    captures = {str(k): load("procam_board", f"capture_{k}.json") for k in (0, 1)}
    found = check_calibration(captures, adjust=True)
    assert found.check.status == "does not hold"
    assert found.check.measurements[0].source == "the projector's two axes"
    assert found.adjustment.refusal
