"""One reader for rigs of any kind, the writer, and `planish convert-rig`."""

import json

import cv2
import numpy as np
import pytest

from command_line import planish
from mat_files import write_v5, write_v5_object
from planish import read_rig, write_rig
from planish.errors import InputError
from planish.rig import Rig
from planish.rig.files import import_rig
from sequences import small_rig
from test_matlab_rig import camera_struct, stereo_struct

#: What composing and inverting float64 transforms of a metre may leave [mm].
ROUNDING_MM = 1e-9


@pytest.fixture
def rig():
    """Two cameras in the frame of A, with a covariance."""
    pair = small_rig(with_projector=False).in_frame_of("A")
    return Rig(pair.cameras, None, np.diag([0.01, 0.04]), ("A.fx", "B.rotation_x"))


def assert_same(a, b):
    assert list(a.devices) == list(b.devices)
    for name, device in a.devices.items():
        np.testing.assert_allclose(device.kernel_parameters, b.devices[name].kernel_parameters, atol=ROUNDING_MM)
        assert device.size_px == b.devices[name].size_px


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("rig.json", "planish"),
        ("rig.yml", "OpenCV"),
        ("rig.yaml", "OpenCV"),
        ("rig.XML", "OpenCV"),
        ("rig.mat", "MATLAB"),
    ],
)
def test_every_kind_is_written_and_read_by_its_name(tmp_path, rig, name, source):
    lost = write_rig(rig, tmp_path / name)
    imported = import_rig(tmp_path / name)
    assert imported.format == source
    assert_same(imported.rig, rig)
    assert (imported.rig.covariance is None) == (source != "planish")
    assert any("covariance of 2 parameters" in note for note in lost) == (source != "planish")
    assert_same(read_rig([str(tmp_path / name)]), rig)


def test_the_content_tells_the_kind_where_the_name_does_not(tmp_path, rig):
    for name in ("rig.json", "rig.yml", "rig.mat"):
        write_rig(rig, tmp_path / name)
        (tmp_path / name).rename(tmp_path / f"{name}.calibration")
        assert_same(read_rig(tmp_path / f"{name}.calibration"), rig)


def test_what_is_no_rig_is_refused_with_what_would_be_one(tmp_path, rig):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match=r"notes\.txt: no calibration .* a rig\.json, an OpenCV .*MAT-file"):
        read_rig(tmp_path / "notes.txt")
    with pytest.raises(InputError, match=r"missing\.yml: cannot be read"):
        read_rig(tmp_path / "missing.yml")
    with pytest.raises(InputError, match="rig: no file"):
        read_rig([])
    write_rig(rig, tmp_path / "a.json")
    write_rig(rig, tmp_path / "b.yml")
    with pytest.raises(InputError, match=r"several files: .*a\.json \(planish\), .*b\.yml \(OpenCV\)"):
        read_rig([tmp_path / "a.json", tmp_path / "b.yml"])
    with pytest.raises(InputError, match=r"ends in '\.txt'; expected one of \.json, \.yml"):
        write_rig(rig, tmp_path / "rig.txt")
    with pytest.raises(InputError, match="devices: found A; expected all"):
        write_rig(rig, tmp_path / "rig.json", ("A",))


def test_opencv_and_matlab_say_the_same_of_one_rig(tmp_path, rig):
    write_rig(rig, tmp_path / "rig.yml")
    write_rig(read_rig(tmp_path / "rig.yml"), tmp_path / "rig.mat")
    assert_same(read_rig(tmp_path / "rig.mat"), rig)


def test_convert_rig_says_what_it_understood_and_converted(tmp_path):
    write_v5(tmp_path / "in.mat", stereoParams=stereo_struct())
    done = planish("convert-rig", tmp_path / "in.mat", "--out", tmp_path / "rig.json", "--frame", "B")
    assert done.code == 0
    lines = done.out.splitlines()
    assert lines[0].startswith("camera A: 640 x 480 px, focal length 1000.000, 1100.000 px, principal point 320.000")
    assert lines[0].endswith("skew 2.000; distortion k1 k2 p1 p2")
    # |(10, 20, 30)| and a quarter turn.
    assert lines[2] == "camera A to camera B: 37.417 mm, turned by 90.000 deg"
    assert lines[3] == "no covariance"
    assert lines[4].startswith("from MATLAB: the struct 'stereoParams'; pixel centres start at (1, 1)")
    np.testing.assert_array_equal(Rig.load(tmp_path / "rig.json").cameras["B"].T_camera_sensor, np.eye(4))


def test_convert_rig_warns_of_what_the_file_cannot_hold(tmp_path, rig):
    rig.save(tmp_path / "rig.json")
    done = planish("convert-rig", tmp_path / "rig.json", "--out", tmp_path / "rig.yml")
    assert done.code == 0
    assert "covariance of 2 parameters" in done.out
    assert f"warning: {tmp_path / 'rig.yml'}: not in the file: the covariance of 2 parameters" in done.err
    moved = planish("convert-rig", tmp_path / "rig.json", "--out", tmp_path / "b.json", "--frame", "B")
    assert (moved.code, moved.err) == (0, "")
    assert Rig.load(tmp_path / "b.json").covariance is not None


def test_convert_rig_takes_sizes_devices_and_variables(tmp_path):
    out = cv2.FileStorage(str(tmp_path / "in.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in {"cam_K": np.eye(3), "proj_K": np.eye(3), "R": np.eye(3), "T": np.ones(3)}.items():
        out.write(name, value)
    for name in ("cam_kc", "proj_kc"):
        out.write(name, np.zeros(5))
    out.release()
    sizes = ("--size", "640x480", "--projector-size", "1280X800")
    assert planish("convert-rig", tmp_path / "in.yml", "--out", tmp_path / "rig.json", *sizes).code == 0
    rig = read_rig(tmp_path / "rig.json")
    assert (rig.cameras["A"].size_px, rig.projector.size_px) == ((640, 480), (1280, 800))
    only_a = planish("convert-rig", tmp_path / "rig.json", "--out", tmp_path / "a.mat", "--devices", "A")
    assert only_a.code == 0
    assert "not in the file: projector" in only_a.err
    write_v5(tmp_path / "two.mat", one=camera_struct(), other=camera_struct(ImageSize=[600.0, 800.0]))
    named = planish("convert-rig", tmp_path / "two.mat", "--variable", "other", "--out", tmp_path / "o.json")
    assert named.out.startswith("camera A: 800 x 600 px")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["missing.yml", "--out", "o.json"], "missing.yml: cannot be read"),
        (["rig.json", "--out", "o.txt"], "ends in '.txt'"),
        (["rig.json", "--out", "o.json", "--size", "640"], "--size: found '640'; expected WIDTHxHEIGHT"),
        (["rig.json", "--out", "o.json", "--frame", "C"], "frame: found 'C'"),
        (["rig.json", "--out", "o.yml", "--frame", "B"], "--frame: found 'B'; expected a .json file"),
        (["rig.json", "--out", "o.yml", "--devices", "A,projector"], "devices: found A, projector; the rig has A, B"),
        (["rig.yml", "--out", "o.json", "--size", "640x480"], "calibrated with 200 x 150 px"),
        (["object.mat", "--out", "o.json"], "s = toStruct(stereoParams); save('x.mat', 's')"),
        (["two.mat", "--out", "o.json"], "several calibrations: left, right"),
    ],
)  # fmt: skip
def test_convert_rig_refuses_without_a_traceback_and_writes_nothing(tmp_path, rig, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    write_rig(rig, tmp_path / "rig.json")
    write_rig(rig, tmp_path / "rig.yml")
    write_v5_object(tmp_path / "object.mat", "stereoParams", "stereoParameters")
    write_v5(tmp_path / "two.mat", left=camera_struct(), right=camera_struct())
    done = planish("convert-rig", *arguments)
    assert done.code == 2
    assert words in " ".join(done.err.split())
    assert done.out == ""
    assert not list(tmp_path.glob("o.*"))


def test_a_json_file_by_opencv_is_no_planish_rig_but_a_calibration(tmp_path, rig):
    out = cv2.FileStorage(str(tmp_path / "opencv.json"), cv2.FILE_STORAGE_WRITE)
    out.write("camera_matrix", rig.cameras["A"].K)
    out.write("distortion_coefficients", np.zeros(5))
    out.release()
    assert json.loads((tmp_path / "opencv.json").read_text())["camera_matrix"]["type_id"] == "opencv-matrix"
    assert read_rig(tmp_path / "opencv.json", (200, 150)).cameras["A"].size_px == (200, 150)
