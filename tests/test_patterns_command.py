"""`planish patterns` on the command line: what it writes can be projected, recorded and read."""

import sys

import cv2
import numpy as np
import pytest

from planish.cli import main
from planish.sensing.capture.manifest import Capture
from planish.sensing.patterns.sequences import SEQUENCES, encode, named_sequence, projector_image

#: An image holds whole grey levels of 255.
ROUNDING = 0.5 / 255 + 1e-9


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["planish", "patterns", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code or 0


@pytest.mark.parametrize("coding", SEQUENCES)
@pytest.mark.parametrize("axes", ["u", "v"])
def test_the_images_of_every_coding_are_what_its_capture_says(monkeypatch, tmp_path, coding, axes):
    assert run(monkeypatch, tmp_path, "--coding", coding, "--projector", "320x200", "--axes", axes) == 0
    capture = Capture.load(tmp_path)
    images = sorted(tmp_path.glob("*.png"))
    assert capture.manifest.projector_px == (320, 200)
    assert capture.manifest.sequence == named_sequence(coding, (320, 200), axes=(axes,))
    assert len(images) == len(capture.manifest.sequence) == len(capture.manifest.images.A)
    for path, entry in zip(images, capture.manifest.sequence, strict=True):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert (image.dtype, image.shape) == (np.uint8, (200, 320))
        assert np.abs(image / 255 - projector_image(entry, (320, 200))).max() < ROUNDING


def test_names_follow_the_order_of_projection_and_of_recording(monkeypatch, tmp_path, capsys):
    assert run(monkeypatch, tmp_path, "--axes", "both", "--exposures", "5,20", "--coding", "gray-phase") == 0
    capture = Capture.load(tmp_path)
    count = len(capture.manifest.sequence)
    files = sorted(path.name for path in tmp_path.glob("*.png"))
    assert capsys.readouterr().out.splitlines() == files
    assert [name[:2] for name in files] == [f"{k:02d}" for k in range(count)]
    assert [f"B_{k:02d}.png" for k in range(count)] == capture.manifest.images.B
    assert capture.manifest.rig == "rig.json"
    assert [e.exposure_ms for e in capture.manifest.sequence] == [5.0] * (count // 2) + [20.0] * (count // 2)


def test_white_and_black_can_be_left_out_and_one_camera_records(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, "--no-white", "--no-black", "--cameras", 1, "--steps", 3) == 0
    manifest = Capture.load(tmp_path).manifest
    assert {entry.role for entry in manifest.sequence} == {"phase"}
    assert manifest.images.B is None


def test_the_options_reach_the_sequence(monkeypatch, tmp_path):
    options = ("--period", 16, "--steps", 5, "--ratio", 6, "--sign", -1, "--projector", "1024X768")
    assert run(monkeypatch, tmp_path / "a", "--coding", "multi-frequency", *options) == 0
    expected = named_sequence("multi-frequency", (1024, 768), period_px=16, steps=5, ratio=6, sign=-1)
    assert Capture.load(tmp_path / "a").manifest.sequence == expected
    options = ("--bits", 12, "--no-inverses", "--cell", 2)
    assert run(monkeypatch, tmp_path / "b", "--coding", "gray", *options) == 0
    expected = named_sequence("gray", bits=12, inverses=False, cell_px=2.0)
    assert Capture.load(tmp_path / "b").manifest.sequence == expected


def test_the_gamma_of_the_projector_is_made_up_for(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, "--projector", "320x200", "--gamma", 2.2, "--coding", "phase-shift") == 0
    entry = Capture.load(tmp_path).manifest.sequence[0]
    image = cv2.imread(str(min(tmp_path.glob("00_*.png"))), cv2.IMREAD_UNCHANGED)
    assert np.abs((image[0] / 255) ** 2.2 - encode(entry, np.arange(320))).max() < 2.2 * ROUNDING


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--coding", "rainbow"), "one of reference, phase-shift"),
        (("--projector", "1280"), "WIDTHxHEIGHT"),
        (("--axes", "w"), "one of u, v, both"),
        (("--periods", "20,a"), "--periods"),
        (("--steps", 2), "at least 3"),
        (("--sign", 3), "sign"),
        (("--coding", "gray", "--steps", 4), "options steps"),
        (("--exposures", "5,5"), "different times"),
        (("--gamma", 0), "gamma"),
        (("--cameras", 3), "1 or 2"),
    ],
)
def test_impossible_patterns_are_refused_with_exit_code_2_and_nothing_is_written(
    monkeypatch, tmp_path, capfd, arguments, message
):
    assert run(monkeypatch, tmp_path / "out", *arguments) == 2
    error = " ".join(capfd.readouterr().err.split())
    assert message in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_named(monkeypatch, tmp_path, capfd):
    (tmp_path / "file").write_text("in the way")
    assert run(monkeypatch, tmp_path / "file", "--projector", "64x64", "--coding", "gray") == 2
    assert "file" in capfd.readouterr().err
