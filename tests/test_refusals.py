"""What cannot be registered is refused with a reason; no transform is invented."""

import json

import pytest

from command_line import planish


def registered(folder, scene, scale):
    assert planish("simulate", scene, "--out", folder / "captures", "--seed", 2, "--width-scale", scale,
                   "--no-true-points").code == 0  # fmt: skip
    assert planish("measure", folder / "captures", "--out", folder / "measurements").code == 0
    outcome = planish("register", folder / "measurements", "--out", folder / "out", "--no-cloud")
    return outcome, json.loads((folder / "out" / "registration.json").read_text())


@pytest.mark.parametrize(
    ("scene", "scale", "words"),
    # At full resolution dust alone would make a significant consensus; what is fixed to the sensor has been removed.
    [("disjoint", 0.5, "overlap"), ("blank", 1.0, "not significant")],
    ids=["captures that do not overlap", "a plate without texture, with PRNU and dust"],
)
def test_is_refused_with_the_reason_and_exit_code_0(tmp_path, scene, scale, words):
    outcome, content = registered(tmp_path, scene, scale)
    assert outcome.code == 0
    (pair,) = content["pairs"]
    assert pair["status"] == "refused"
    assert words in pair["reason"]
    assert pair["T_a_b"] is None
    assert not pair["used"]
    assert [g["reference"] for g in content["groups"]] == ["m1", "m2"]
    assert "no pair was accepted" in outcome.out
    assert (tmp_path / "out" / "report.html").is_file()
