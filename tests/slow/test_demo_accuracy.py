"""The demo's five measurements at full resolution, for five seeds, against truth."""

import json

import pytest

from command_line import planish

#: The issue's limits against truth, rms over the true overlap [mm].
ALONG_MM, NORMAL_MM = 0.02, 0.01
CONSECUTIVE = [("m1", "m2"), ("m2", "m3"), ("m3", "m4"), ("m4", "m5")]

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_every_pair_of_the_demo_is_right(tmp_path, seed):
    outcome = planish("demo", "--out", tmp_path, "--seed", seed)
    assert outcome.code == 0, outcome.err
    registration = json.loads((tmp_path / "registration.json").read_text())
    accepted = {(p["a"], p["b"]) for p in registration["pairs"] if p["status"] == "accepted"}
    assert accepted.issuperset(CONSECUTIVE)
    assert "nothing wrong, nothing missing" in outcome.out
    evaluation = json.loads((tmp_path / "evaluation.json").read_text())
    for pair in evaluation["pairs"]:
        assert pair["tangential_rms_mm"] <= ALONG_MM, pair
        assert pair["normal_rms_mm"] <= NORMAL_MM, pair
