import json
import sys

import numpy as np
import pytest

from planish.cli import main
from planish.sensing.capture import Capture
from planish.simulation.render import render_capture, true_points
from planish.simulation.scenes import make_scene


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["planish", "simulate", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code


def test_simulate_writes_captures_that_can_be_loaded_and_their_truth(monkeypatch, tmp_path):
    code = run(monkeypatch, "plate", "--out", tmp_path, "--seed", 5, "--captures", 2, "--width-scale", 0.1)
    assert code == 0
    scene = make_scene("plate", 5, 2, scale=0.1)
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["schema"] == "planish.truth/1"
    assert [m["name"] for m in truth["measurements"]] == ["m1", "m2"]
    for index, item in enumerate(truth["measurements"]):
        assert item["part"] == "plate"
        assert np.array_equal(item["T_object_sensor"], scene.T_object_sensor[index])
        capture = Capture.load(tmp_path / item["name"])
        assert capture.name == item["name"]
        assert np.allclose(capture.load_rig("A").cameras["B"].K, scene.rig.cameras["B"].K)
        images = render_capture(scene, index)
        for camera in "AB":
            assert np.array_equal(capture.read_images(camera), images[camera])
            written = np.load(tmp_path / item["name"] / f"truth_{camera}.npz")
            expected = true_points(scene, index, camera)
            assert written["points_sensor"].dtype == np.float32
            assert np.array_equal(written["points_sensor"], expected.astype(np.float32), equal_nan=True)
            assert written["seen"].shape == expected.shape[:2]


def test_simulate_writes_fringes_and_gray_code_in_sixteen_bit_without_points(monkeypatch, tmp_path):
    arguments = ("--captures", 1, "--width-scale", 0.1, "--sequence", "gray-phase", "--bits", 16, "--no-true-points")
    assert run(monkeypatch, "plate", "--out", tmp_path, *arguments) == 0
    capture = Capture.load(tmp_path / "m1")
    assert [entry.role for entry in capture.manifest.sequence].count("gray") == 7
    assert capture.read_image("A", 0).dtype == np.uint16
    assert not list(tmp_path.rglob("*.npz"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("spoon",), "one of door, plate"),
        (("door", "--captures", 0), "captures: found 0"),
        (("door", "--sequence", "rainbow"), "one of reference, phase-shift"),
        (("door", "--bits", 12), "8 or 16"),
        (("door", "--exposure", -1), "exposure"),
        (("door", "--threads", 0), "threads: found 0"),
    ],
)
def test_simulate_refuses_bad_input_with_exit_code_2(monkeypatch, tmp_path, capfd, arguments, message):
    assert run(monkeypatch, *arguments, "--out", tmp_path / "out") == 2
    error = capfd.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_simulate_names_a_folder_that_cannot_be_made(monkeypatch, tmp_path, capfd):
    (tmp_path / "file").write_text("in the way")
    assert run(monkeypatch, "plate", "--width-scale", 0.1, "--captures", 1, "--out", tmp_path / "file") == 2
    assert "cannot be made" in capfd.readouterr().err
