"""The whole chain with a rig that boards calibrated: images of boards, rig, measurements, transforms against truth."""

import json

import pytest
from scipy.stats import chi2

from command_line import planish
from planish import Rig

#: NEES / 6 of 999 of 1000 transforms with a right covariance lies below.
LARGEST_NEES = float(chi2.ppf(0.999, 6)) / 6
HALF = ("--width-scale", 0.5)

pytestmark = pytest.mark.slow


def done(*arguments):
    outcome = planish(*arguments)
    assert outcome.code == 0, outcome.err
    return outcome


@pytest.mark.parametrize("seed", [3, 4])
def test_transforms_by_a_rig_from_boards_are_as_certain_as_stated(tmp_path, seed):
    boards, rig, part = tmp_path / "boards", tmp_path / "rig.json", tmp_path / "part"
    done("simulate-board", "--out", boards, "--views", 14, "--seed", seed, "--fringes", *HALF)
    done("calibrate", boards, "--out", rig, "--keep-frame", boards / "true_rig.json", "--no-report")
    assert Rig.load(rig).covariance is not None
    done("simulate", "door", "--out", part, "--captures", 3, "--seed", seed, *HALF)
    done("measure", part, "--rig", rig, "--out", tmp_path / "measurements")
    done("register", tmp_path / "measurements", "--out", tmp_path / "registered")
    outcome = done("evaluate", tmp_path / "registered", "--truth", part / "truth.json")
    assert "nothing wrong, nothing missing" in outcome.out
    pairs = json.loads((tmp_path / "registered" / "evaluation.json").read_text())["pairs"]
    assert len(pairs) >= 2
    for pair in pairs:
        assert pair["nees"] / 6 < LARGEST_NEES, pair
    placed = json.loads((tmp_path / "registered" / "registration.json").read_text())["pairs"]
    assert all(pair["covariance_calibration"] is not None for pair in placed if pair["status"] == "accepted")
