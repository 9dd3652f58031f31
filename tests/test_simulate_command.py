import json
import sys

import numpy as np
import pytest

from planish.cli import main
from planish.sensing.capture.manifest import Capture
from planish.sensing.patterns.sequences import with_exposures
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


def test_simulate_shows_what_patterns_wrote_under_the_light_that_is_asked_for(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["planish", "patterns", str(tmp_path / "p"), "--coding", "gray", "--axes", "both"])
    with pytest.raises(SystemExit):
        main()
    sequence = tmp_path / "p" / "capture.json"
    light = ("--ambient", 0.4, "--projector-gamma", 2.2, "--highlights", 0.05, "--exposures", "5,20")
    arguments = ("--captures", 1, "--width-scale", 0.1, "--no-true-points", "--sequence", sequence, *light)
    assert run(monkeypatch, "plate", "--out", tmp_path, *arguments) == 0
    capture = Capture.load(tmp_path / "m1")
    projected = Capture.load(tmp_path / "p").manifest.sequence
    assert capture.manifest.sequence == with_exposures(projected, [5.0, 20.0])
    short, long = (capture.read_image("A", k * len(projected) + len(projected) - 2) for k in (0, 1))
    black = capture.read_image("A", 2 * len(projected) - 1)
    assert (long == 255).mean() > 0.02
    assert (short == 255).mean() < 0.01
    # Room light is 0.4 of a white level of 175, on all of the plate; 8 % more or less with the distance.
    assert np.median(black) == pytest.approx(5 + 0.4 * 175, rel=0.15)


@pytest.mark.parametrize(
    ("content", "message"),
    [({"projector_px": [640, 480]}, "projector_px: found (640, 480)"), ({"rig": 3}, "'rig.str' is 3")],
)
def test_simulate_refuses_a_sequence_for_another_projector(monkeypatch, tmp_path, capfd, content, message):
    manifest = {
        "schema": "planish.capture/1",
        "rig": "rig.json",
        "images": {"A": ["a"]},
        "sequence": [{"role": "white"}],
    }
    (tmp_path / "capture.json").write_text(json.dumps(manifest | content))
    assert run(monkeypatch, "plate", "--out", tmp_path / "o", "--sequence", tmp_path / "capture.json") == 2
    assert message in " ".join(capfd.readouterr().err.split())
