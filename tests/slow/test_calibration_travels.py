"""Pairs measured with rigs drawn from their stated covariance, from images to transforms: the benchmark in small."""

import pytest

from calibration_travels import run_surface

#: 6 drawn rigs of 6 parameters, and the noise of one pair of captures, know a mean NEES / 6 to 0.3.
NEES_PER_DOF = (0.4, 1.8)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("surface", ["plate", "door"])
def test_errors_of_drawn_rigs_stay_inside_the_stated_total_covariance(surface):
    row = run_surface(surface, [1], 6)
    assert row["draws"] == 6
    assert NEES_PER_DOF[0] < row["total"] < NEES_PER_DOF[1]
    # Without the calibration's part the same transforms lie far outside.
    assert row["noise"] > 10
