"""What the real captures say about themselves: they are good ones, and no check may refuse them or warn."""

import pytest
from captures import measured

#: Measured: 0.10 px within the 12 steps of the ball, 0.016 px within the 6 steps on the steel, whose black image shows
#: the strong room light.
MOVEMENT_PX = {"ball_12step": 0.15, "steel_corner_shiftline": 0.03}


@pytest.mark.parametrize("name", MOVEMENT_PX)
def test_a_good_capture_is_neither_refused_nor_warned_of(name):
    findings = measured(name).findings
    assert [finding.warning for finding in findings if finding.warning] == []
    movements = [finding.value for finding in findings if finding.quantity.startswith("movement")]
    known = [value for value in movements if value is not None]
    assert len(known) >= 2
    assert max(known) <= MOVEMENT_PX[name]


def test_the_rows_of_the_steel_rig_are_off_and_of_the_ball_not_observable():
    (steel,) = [f for f in measured("steel_corner_shiftline").findings if f.quantity.startswith("row error")]
    # The calibration's own epipolar residual is a fraction of a pixel, different over the image.
    assert 0.1 < steel.value < 0.6
    assert steel.sigma < 0.1
    (ball,) = [f for f in measured("ball_12step").findings if f.quantity.startswith("row error")]
    assert ball.value is None
