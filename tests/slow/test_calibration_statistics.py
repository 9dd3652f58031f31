"""Calibrations of 200 draws against their covariance, pitch drawn as well: DESIGN section 6."""

import numpy as np
import pytest

from calibrate import FAULTS, SENSORS, draws_of, fault_row, row

#: The limits: mean NEES / dof, coverage of 95 % intervals [%], true over expected 3D error (median over the map).
NEES, COVERAGE, POINTS = (0.8, 1.25), (92.0, 98.0), (0.8, 1.2)
DRAWS = 200
#: Share of errors within 3 predicted standard deviations [%]; 99.73 for normal ones.
INSIDE_3_SIGMA = 99.0

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("sensor", SENSORS)
def test_errors_are_those_that_the_covariance_says(sensor):
    found = row(sensor, draws_of(SENSORS[sensor], range(DRAWS)))
    assert NEES[0] <= found["nees"] <= NEES[1]
    assert COVERAGE[0] <= found["coverage"] <= COVERAGE[1]
    assert POINTS[0] <= found["points_ratio"] <= POINTS[1]
    assert found["inside_3_sigma"] >= INSIDE_3_SIGMA


@pytest.mark.parametrize("fault", [name for name in FAULTS if name != "none"])
def test_wrong_boards_are_always_reported(fault):
    found = fault_row(fault)
    assert found["reported"] == 100
    assert abs(found["value"] - found["true"]) <= 3 * found["sigma"]
    assert np.isfinite(found["nees"])
    assert found["nees"] <= NEES[1]
