import json
import sys

import cv2
import numpy as np
import pytest

from planish.cli import main
from planish.rig import Rig
from planish.sensing.capture.board import load_board
from planish.sensing.capture.manifest import Capture
from planish.simulation.board_places import see_board
from planish.simulation.boards import PrintedBoard

CHARUCO = {"schema": "planish.board/1", "kind": "charuco", "squares": [9, 6], "pitch_mm": 24.0, "marker_mm": 18.0}
SMALL = ("--width-scale", 0.3, "--views", 2)


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["planish", "simulate-board", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code


def test_single_images_lie_in_a_folder_per_camera_beside_board_and_truth(monkeypatch, tmp_path):
    path = tmp_path / "charuco.json"
    path.write_text(json.dumps(CHARUCO))
    out = tmp_path / "out"
    assert run(monkeypatch, "--out", out, "--board", path, "--seed", 4, *SMALL) == 0
    names = {str(file.relative_to(out)) for file in out.rglob("*") if file.is_file()}
    images = {f"{camera}/{view}.png" for camera in "AB" for view in ("01", "02")}
    assert names == images | {"board.json", "true_rig.json", "true_boards.json"}
    board, rig = load_board(out / "board.json"), Rig.load(out / "true_rig.json")
    assert board == load_board(path)
    truth = json.loads((out / "true_boards.json").read_text())
    assert truth["schema"] == "planish.board_truth/1"
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((9, 6), 24, 18, dictionary))
    for view in truth["views"]:
        seen = see_board(rig, PrintedBoard(board), np.array(view["T_sensor_board"]))
        for camera in "AB":
            image = cv2.imread(str(out / camera / f"{view['name']}.png"), cv2.IMREAD_GRAYSCALE)
            corners, ids, _, _ = detector.detectBoard(image)
            # At a third of the resolution OpenCV misses some.
            assert len(ids) > 20
            assert np.median(np.abs(corners.reshape(-1, 2) - seen[camera].pixel_px[np.ravel(ids)])) < 0.2


def test_fringes_come_as_captures_without_a_rig_and_the_file_keeps_to_itself_what_is_wrong_with_the_board(
    monkeypatch, tmp_path
):
    wrong = ("--sagitta-mm", 1, "--scale", 1.002, "--pitch-ratio", 1.001, "--cameras", "A")
    assert run(monkeypatch, "--out", tmp_path, "--fringes", "--sequence", "gray-phase", *wrong, *SMALL) == 0
    for name in ("01", "02"):
        capture = Capture.load(tmp_path / name)
        assert (capture.name, capture.cameras, capture.manifest.rig) == (name, ("A",), None)
        assert {entry.axis for entry in capture.manifest.sequence if entry.role == "phase"} == {"u", "v"}
        assert len(capture.read_images("A")) == len(capture.manifest.sequence)
        assert not (tmp_path / name / "rig.json").exists()
    assert load_board(tmp_path / "board.json").pitch_mm == 20.0
    truth = np.array(json.loads((tmp_path / "true_boards.json").read_text())["points_board_mm"]).reshape(8, 11, 3)
    assert np.abs(np.ptp(truth[..., 2]) - 1) < 1e-3
    assert truth[1, 0, 1] - truth[0, 0, 1] == pytest.approx(20 * 1.002 * 1.001)
    assert truth[0, 6, 0] - truth[0, 5, 0] == pytest.approx(20 * 1.002, rel=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--views", 0), "count: found 0"),
        (("--scale", -1), "scale: found"),
        (("--sagitta-mm", 99), "sagitta_mm: found 99"),
        (("--tilt-deg", 90), "tilt_deg: found 90"),
        (("--width-scale", 9), "width scale: found 9"),
        (("--seed", -1), "seed: found -1"),
        (("--noise-factor", -1), "noise factor: found -1"),
        (("--fringes", "--sequence", "rainbow"), "one of reference, phase-shift"),
        (("--board", "nowhere.json"), "nowhere.json"),
    ],
)
def test_bad_input_is_refused_with_exit_code_2(monkeypatch, tmp_path, capfd, arguments, message):
    assert run(monkeypatch, "--out", tmp_path / "out", *arguments) == 2
    error = " ".join(capfd.readouterr().err.split())
    assert message in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("content", "message"),
    [({"kind": "spoon"}, "kind"), ({"pitch_mm": -1}, "pitch_mm"), ({"marker_mm": 30}, "marker_mm")],
)
def test_a_board_file_that_describes_no_board_is_refused(monkeypatch, tmp_path, capfd, content, message):
    (tmp_path / "board.json").write_text(json.dumps(CHARUCO | content))
    assert run(monkeypatch, "--out", tmp_path / "out", "--board", tmp_path / "board.json") == 2
    assert message in capfd.readouterr().err


def test_a_folder_that_cannot_be_made_is_named(monkeypatch, tmp_path, capfd):
    (tmp_path / "file").write_text("in the way")
    assert run(monkeypatch, "--out", tmp_path / "file", *SMALL) == 2
    assert "cannot be made" in capfd.readouterr().err
