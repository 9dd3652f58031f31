"""`planish measure` on the command line: what it writes, and how it refuses bad input."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest

from command_line import planish
from planish.cli import main
from planish.measurement import Measurement
from sequences import gray_entries, manifest, phase_entries, plane_points, render, small_rig


def write_capture(folder, rig, entries, name=None):
    """A plane seen by both cameras of `rig`, in 8-bit PNG files."""
    folder.mkdir(parents=True)
    plan = manifest(entries, projector_px=(320, 200))
    for camera in "AB":
        positions = rig.projector.project(plane_points(rig.cameras[camera]))[..., 0]
        names = plan.images.A if camera == "A" else plan.images.B
        for file, image in zip(
            names, render(plan.sequence, positions, noise=(1.0, 0.02), seed=ord(camera)), strict=True
        ):
            cv2.imwrite(str(folder / file), image)
    rig.save(folder / "rig.json")
    content = plan.model_dump(mode="json", by_alias=True, exclude_none=True)
    (folder / "capture.json").write_text(json.dumps(content | ({} if name is None else {"name": name})))


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "part"
    write_capture(folder, small_rig(), [*phase_entries([320, 40]), {"role": "white"}, {"role": "black"}])
    return folder


@pytest.fixture
def capture(good, tmp_path):
    return shutil.copytree(good, tmp_path / "part")


def run(monkeypatch, *arguments):
    """Run the program; return its exit code."""
    monkeypatch.setattr(sys, "argv", ["planish", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code or 0


def refused(monkeypatch, capsys, *arguments):
    """Require exit code 2 without a traceback; return the message on one line."""
    assert run(monkeypatch, *arguments) == 2
    out, message = capsys.readouterr()
    assert "Traceback" not in message
    assert out == ""
    return " ".join(message.split())


def edit(capture, change):
    content = json.loads((capture / "capture.json").read_text())
    change(content)
    (capture / "capture.json").write_text(json.dumps(content))


def one_camera_alone(capture):
    edit(capture, lambda m: m["images"].pop("B"))
    rig = json.loads((capture / "rig.json").read_text())
    (capture / "rig.json").write_text(json.dumps(rig | {"projector": None}))


@pytest.mark.parametrize("path", ["part", "part/capture.json", "."])
def test_a_capture_is_named_by_its_file_its_folder_or_the_folder_above(capture, tmp_path, monkeypatch, capsys, path):
    assert run(monkeypatch, "measure", tmp_path / path, "--out", tmp_path / "out", "--threads", 2) == 0
    m = Measurement.load(tmp_path / "out" / "part.h5")
    line = capsys.readouterr().out
    assert line.startswith(f"part: {m.valid.sum()} points, ")
    assert "median sigma" in line
    truth = plane_points(m.camera)
    # 40 px per fringe, noise 1.5 of 80 levels: 0.06 px, of 5 mm each.
    assert np.median(np.abs(m.points_sensor - truth)[m.valid]) < 0.5


def test_camera_and_texture_can_be_chosen_and_images_lie_elsewhere(capture, tmp_path, monkeypatch):
    (tmp_path / "images").mkdir()
    for image in capture.glob("*.png"):
        image.rename(tmp_path / "images" / image.name)
    code = run(
        monkeypatch, "measure", capture, "--images", tmp_path / "images", "--out", tmp_path / "out",
        "--organise-on", "B", "--texture-views", "B",
    )  # fmt: skip
    assert code == 0
    m = Measurement.load(tmp_path / "out" / "part.h5")
    assert (m.organised_on, m.texture_views) == ("B", ("B",))


def test_a_mask_excludes_pixels(capture, tmp_path, monkeypatch):
    mask = np.zeros((150, 200), np.uint8)
    mask[:, 80:120] = 255
    cv2.imwrite(str(capture / "mask.png"), mask)
    edit(capture, lambda c: c.update(mask={"A": "mask.png"}))
    assert run(monkeypatch, "measure", capture, "--out", tmp_path / "out") == 0
    m = Measurement.load(tmp_path / "out" / "part.h5")
    assert m.valid.any()
    assert not m.valid[mask == 0].any()


def test_gray_code_counts_the_fringes_here_too(tmp_path, monkeypatch):
    write_capture(tmp_path / "gray", small_rig(), [*phase_entries([40], steps=6), *gray_entries(4, 20, inverse=True)])
    assert run(monkeypatch, "measure", tmp_path / "gray", "--out", tmp_path / "out") == 0
    m = Measurement.load(tmp_path / "out" / "gray.h5")
    assert np.median(np.abs(m.points_sensor - plane_points(m.camera))[m.valid]) < 0.5


def truncate(path):
    path.write_bytes(path.read_bytes()[:2000])


def resize(path):
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-1])


def colour(path):
    cv2.imwrite(str(path), np.zeros((150, 200, 3), np.uint8))


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda c: (c / "B_03.png").unlink(), ["B_03.png", "no such file"]),
        (lambda c: truncate(c / "A_02.png"), ["A_02.png", "truncated"]),
        (lambda c: resize(c / "A_02.png"), ["A_02.png", "200 x 149", "200 x 150"]),
        (lambda c: colour(c / "A_02.png"), ["A_02.png", "3 channels", "grey image"]),
        (lambda c: [resize(c / f"A_{i:02d}.png") for i in range(10)], ["A_00.png", "200 x 149", "camera A of the rig"]),
        (lambda c: edit(c, lambda m: m.update(comment="x")), ["unknown key 'comment'"]),
        (lambda c: edit(c, lambda m: m["sequence"][0].update(role="fringe")), ["capture.json", "fringe"]),
        (lambda c: edit(c, lambda m: m["sequence"][2].update(step=1)), ["steps [0, 1, 1, 3] of 4"]),
        (lambda c: edit(c, lambda m: m.update(sequence=[{"role": "white"}] * 10)), ["nothing that encodes a position"]),
        (lambda c: edit(c, lambda m: m["images"]["A"].pop()), ["images.A names 9 images", "10"]),
        (lambda c: one_camera_alone(c), ["images and calibration of A and B, or of the projector"]),
        (lambda c: edit(c, lambda m: m.update(rig="other.json")), ["other.json"]),
        (lambda c: (c / "capture.json").write_text("{"), ["not valid JSON"]),
        (lambda c: (c / "capture.json").unlink(), ["no capture in this folder"]),
    ],
)  # fmt: skip
def test_bad_input_is_refused_with_the_file_and_the_reason(capture, tmp_path, monkeypatch, capsys, damage, expected):
    damage(capture)
    message = refused(monkeypatch, capsys, "measure", capture, "--out", tmp_path / "out")
    for part in expected:
        assert part in message
    assert not list(tmp_path.glob("out/*"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--organise-on", "C"], "organise_on"),
        (["--texture-views", "A,Q"], "texture_views"),
        (["--threads", "0"], "threads"),
        (["--images", "nowhere"], "no such file"),
    ],
)
def test_bad_options_are_refused(capture, tmp_path, monkeypatch, capsys, arguments, expected):
    assert expected in refused(monkeypatch, capsys, "measure", capture, "--out", tmp_path / "out", *arguments)


def test_two_captures_of_one_name_are_refused(capture, tmp_path, monkeypatch, capsys):
    shutil.copytree(capture, tmp_path / "again" / "part")
    message = refused(monkeypatch, capsys, "measure", capture, tmp_path / "again", "--out", tmp_path / "out")
    assert "the name 'part'" in message


def test_a_path_that_does_not_exist_is_refused(tmp_path, monkeypatch, capsys):
    assert "no such file" in refused(monkeypatch, capsys, "measure", tmp_path / "no", "--out", tmp_path / "out")


def test_findings_are_printed_and_a_wrong_rig_is_warned_of_on_stderr(tmp_path):
    assert planish("simulate", "plate", "--out", tmp_path / "captures", "--seed", 4, "--captures", 1,
                   "--width-scale", 0.5, "--no-true-points").code == 0  # fmt: skip
    right = planish("measure", tmp_path / "captures", "--out", tmp_path / "out")
    assert "row error of the rig in camera B: " in right.out
    assert "warning" not in right.err
    rig = tmp_path / "captures" / "m1" / "rig.json"
    content = json.loads(rig.read_text())
    content["cameras"]["B"]["K"][1][2] += 2.0
    rig.write_text(json.dumps(content))
    wrong = planish("measure", tmp_path / "captures", "--out", tmp_path / "out")
    assert wrong.code == 0
    assert "warning: m1: the rig does not fit the images: in camera B points lie -" in wrong.err
    # Within 0.05 px, as in test_rig_checks.
    (finding,) = [f for f in Measurement.load(tmp_path / "out" / "m1.h5").findings if f.quantity.startswith("row")]
    assert finding.value == pytest.approx(-2.0, abs=0.05)
