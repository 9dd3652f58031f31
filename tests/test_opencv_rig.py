"""Calibrations by OpenCV: two cameras, a camera and a projector, a camera; read, written, and judged by OpenCV."""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planish.errors import InputError
from planish.geometry import compose, exp_se3, exp_so3, transform_points
from planish.rig import Camera, Rig
from planish.rig.exchange.opencv import read_opencv_rig, write_opencv_rig

K_CAMERA = np.array([[3452.4, 0, 587.2], [0, 3449.9, 521.4], [0, 0, 1]])
K_PROJECTOR = np.array([[3953.7, 0, 737.2], [0, 3893.3, 1357.8], [0, 0, 1]])
R, T = exp_so3([-0.08, 0.0, -0.01]), np.array([[85.7], [-630.5], [-100.8]])
#: Files hold all digits; what is left is the rounding of T_B_sensor T_A_sensor^-1 (metres of baseline).
ROUNDING = 1e-12
#: OpenCV projects in float64 as we do.
OPENCV_TOLERANCE_PX = 1e-7


def write(path, **matrices):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, matrix in matrices.items():
        if isinstance(matrix, list):
            storage.startWriteStruct(name, cv2.FileNode_SEQ | cv2.FileNode_FLOW, "")
            for number in matrix:
                storage.write("", number)
            storage.endWriteStruct()
        else:
            storage.write(name, matrix)
    storage.release()
    return path


def projector_matrices(rotation="rotation"):
    return {
        "cam_int": K_CAMERA, "cam_dist": np.array([[-0.22, -0.87, -7e-4, -1.7e-3, 3.1]]),
        "proj_int": K_PROJECTOR, "proj_dist": np.array([[-0.017, -0.44, -9e-3, -0.021, 1.7]]),
        rotation: R, "translation": T,
    }  # fmt: skip


def stereo_matrices():
    return {"M1": K_CAMERA, "D1": np.zeros((1, 5)), "M2": K_CAMERA, "D2": np.zeros((1, 5)), "R": R, "T": T}


@pytest.mark.parametrize("suffix", ["xml", "yml", "json"])
@pytest.mark.parametrize("rotation", ["rotation", "roration"])
def test_a_camera_and_a_projector_are_read(tmp_path, suffix, rotation):
    path = write(tmp_path / f"calibration.{suffix}", **projector_matrices(rotation))
    rig = read_opencv_rig([path], (1280, 1024), (2048, 1536)).rig
    assert set(rig.cameras) == {"A"}
    assert (rig.cameras["A"].size_px, rig.projector.size_px) == ((1280, 1024), (2048, 1536))
    assert np.array_equal(rig.projector.K, K_PROJECTOR)
    assert rig.projector.distortion[:5] == pytest.approx([-0.017, -0.44, -9e-3, -0.021, 1.7])
    # x_projector = R x_camera + T, and the camera is the sensor frame; OpenCV's own projection is the judge.
    point = np.array([40.0, -30.0, 3500.0])
    expected = cv2.projectPoints(point[None], cv2.Rodrigues(R)[0], T, K_PROJECTOR, projector_matrices()["proj_dist"])[0]
    assert rig.projector.project(point) == pytest.approx(expected.ravel(), abs=1e-6)


def test_without_a_projector_matrix_two_cameras_are_read(tmp_path):
    rig = read_opencv_rig([write(tmp_path / "stereo.yml", **stereo_matrices())], (1280, 1024)).rig
    assert set(rig.cameras) == {"A", "B"}
    assert rig.projector is None
    assert rig.cameras["B"].T_camera_sensor[:3, 3] == pytest.approx(T.ravel())


def test_a_single_camera_as_opencvs_own_sample_writes_it_is_read(tmp_path):
    path = write(
        tmp_path / "camera.yml",
        image_width=1280, image_height=1024, camera_matrix=K_CAMERA, distortion_coefficients=np.ones((5, 1)) / 10,
    )  # fmt: skip
    rig = read_opencv_rig([path]).rig
    assert set(rig.devices) == {"A"}
    assert rig.cameras["A"].size_px == (1280, 1024)
    np.testing.assert_array_equal(rig.cameras["A"].K, K_CAMERA)


@pytest.mark.parametrize(
    "size",
    [
        {"imageSize": [1280, 1024]},
        {"S": np.array([[1280.0], [1024.0]])},
        {"img_shape": np.array([[1024.0], [1280.0]])},
        {"image_width": 1280, "image_height": 1024},
    ],
    ids=["imageSize", "S", "img_shape", "image_width"],
)
def test_the_size_that_the_file_tells_is_used_and_compared(tmp_path, size):
    path = write(tmp_path / "stereo.yml", **stereo_matrices(), **size)
    assert [camera.size_px for camera in read_opencv_rig([path]).rig.cameras.values()] == [(1280, 1024)] * 2
    assert read_opencv_rig([path], (1280, 1024)).rig.cameras["B"].size_px == (1280, 1024)
    with pytest.raises(InputError, match=r"A: calibrated with 1280 x 1024 px; expected 640 x 480 px"):
        read_opencv_rig([path], (640, 480))


def test_an_unknown_size_and_a_missing_matrix_are_named(tmp_path):
    path = write(tmp_path / "calibration.xml", **projector_matrices())
    with pytest.raises(InputError, match=r"A: its size is not in the calibration; expected .*--size"):
        read_opencv_rig([path])
    with pytest.raises(InputError, match=r"projector: its size .*projector_px.*--projector-size"):
        read_opencv_rig([path], (1280, 1024))
    matrices = projector_matrices()
    del matrices["translation"]
    path = write(tmp_path / "less.xml", **matrices)
    with pytest.raises(InputError, match="no matrix named translation or T"):
        read_opencv_rig([path], (1280, 1024), (2048, 1536))
    with pytest.raises(InputError, match="no camera matrix; expected one named M1, cam_int, camera_matrix"):
        read_opencv_rig([write(tmp_path / "none.yml", R=R)], (1280, 1024))


@pytest.mark.parametrize(
    ("old", "new"), [("cols: 3", "kols: 3"), ("rows: 3", "rows: 4"), ("dt: d", "dt: d\n   data: [ 1. ]")]
)
def test_a_matrix_that_is_not_whole_is_named(tmp_path, old, new):
    path = write(tmp_path / "stereo.yml", **stereo_matrices())
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=r"stereo\.yml(: M1: no whole matrix| cannot be read|: cannot be read)"):
        read_opencv_rig([path], (1280, 1024))


def test_an_empty_distortion_is_none(tmp_path):
    path = write(tmp_path / "stereo.yml", **{**stereo_matrices(), "D1": np.zeros((0, 0))})
    assert not read_opencv_rig([path], (1280, 1024)).rig.cameras["A"].distortion.any()


def test_skew_in_a_file_is_read_and_said(tmp_path):
    skewed = K_CAMERA + [[0, 1.5, 0], [0, 0, 0], [0, 0, 0]]
    imported = read_opencv_rig([write(tmp_path / "s.yml", **{**stereo_matrices(), "M2": skewed})], (1280, 1024))
    assert imported.rig.cameras["B"].K[0, 1] == 1.5
    assert imported.notes[-1] == "camera B: a skew of 1.5 px, which OpenCV's functions ignore"


def camera(values, size_px):
    fx, fy, cx, cy, *rest = values
    return Camera.make([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rest[:-6], size_px, exp_se3(rest[-6:]))


@st.composite
def rigs(draw):
    """A camera with a second one, with a projector, or alone; distortion of 0 to 12 terms; any sensor frame."""

    def numbers(count, size):
        return draw(st.lists(st.floats(-size, size, allow_subnormal=False), min_size=count, max_size=count))

    def values():
        focal = [1000 + number for number in numbers(2, 500)]
        return [*focal, *numbers(2, 700), *numbers(draw(st.sampled_from([0, 4, 5, 8, 12])), 0.3), *numbers(3, 1.5)]

    first = camera([*values(), *numbers(3, 900)], (1280, 1024))
    second = camera([*values(), *numbers(3, 900)], draw(st.sampled_from([(1280, 1024), (640, 480)])))
    kind = draw(st.sampled_from(["stereo", "projector", "single"]))
    cameras = {"A": first, "B": second} if kind == "stereo" else {"A": first}
    return Rig(cameras, second if kind == "projector" else None)


@settings(max_examples=40, deadline=None)
@given(rigs(), st.sampled_from(["yml", "xml"]))
def test_a_rig_survives_its_opencv_file(rig, suffix):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"rig.{suffix}"
        write_opencv_rig(rig, path)
        loaded = read_opencv_rig([path]).rig
    expected = rig.in_frame_of("A")
    assert list(loaded.devices) == list(expected.devices)
    for name, device in expected.devices.items():
        np.testing.assert_array_equal(loaded.devices[name].K, device.K)
        np.testing.assert_array_equal(loaded.devices[name].distortion, device.distortion)
        np.testing.assert_allclose(loaded.devices[name].T_camera_sensor, device.T_camera_sensor, atol=1e3 * ROUNDING)
        assert loaded.devices[name].size_px == device.size_px


@pytest.mark.parametrize("second", ["B", "projector"])
def test_opencv_projects_with_the_written_file_as_the_rig_does(tmp_path, second):
    T_A = exp_se3([0.1, -0.2, 0.05, 30.0, -10.0, 700.0])
    other = Camera.make(K_PROJECTOR, [0.1, -0.2, 1e-3, 2e-3, 0.05, 0.1, 0.02, 0.01], (1024, 768), compose(R, T) @ T_A)
    first = Camera.make(K_CAMERA, [-0.2, 0.1, 1e-3, -2e-3], (1280, 1024), T_A)
    rig = Rig({"A": first, "B": other}) if second == "B" else Rig({"A": first}, other)
    lost = write_opencv_rig(rig, tmp_path / "rig.yml")
    assert lost == ("not in the file: the sensor frame; its place takes that of camera A",)
    file = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    names = ("M2", "D2", "R", "T") if second == "B" else ("proj_int", "proj_dist", "rotation", "translation")
    K, distortion, rotation, translation = (file.getNode(name).mat() for name in names)
    points = np.random.default_rng(0).uniform(-200, 200, (50, 3))
    points_A = transform_points(T_A, points)
    pixels = cv2.projectPoints(points_A, cv2.Rodrigues(rotation)[0], translation, K, distortion)[0][:, 0]
    np.testing.assert_allclose(pixels, rig.devices[second].project(points), atol=OPENCV_TOLERANCE_PX)


def three_devices():
    camera_b = Camera.make(K_CAMERA, [], (1280, 1024), compose(R, T))
    cameras = {"A": Camera.make(K_CAMERA, [], (1280, 1024), np.eye(4)), "B": camera_b}
    return Rig(cameras, Camera.make(K_PROJECTOR, [], (1024, 768), compose(R, 2 * T)), np.eye(2), ("A.fx", "B.fx"))


def test_three_devices_need_a_choice_and_two_files(tmp_path):
    rig = three_devices()
    with pytest.raises(InputError, match=r"the rig has A, B, projector; expected .*A,B or A,projector.*--devices"):
        write_opencv_rig(rig, tmp_path / "rig.yml")
    lost = write_opencv_rig(rig, tmp_path / "stereo.yml", ("A", "B"))
    assert lost == (
        "not in the file: projector",
        "not in the file: the covariance of 2 parameters, for which OpenCV has no place",
    )
    write_opencv_rig(rig, tmp_path / "projector.yml", ("A", "projector"))
    loaded = read_opencv_rig([tmp_path / "projector.yml"]).rig
    np.testing.assert_array_equal(loaded.projector.kernel_parameters, rig.projector.kernel_parameters)


@pytest.mark.parametrize("devices", [("projector", "A"), ("A", "C"), ("A", "A"), (), ("A", "B", "projector")])
def test_devices_that_no_file_can_hold_are_refused(tmp_path, devices):
    with pytest.raises(InputError, match=r"rig\.yml: devices"):
        write_opencv_rig(three_devices(), tmp_path / "rig.yml", devices)
    assert list(tmp_path.iterdir()) == []


def test_skew_is_not_written_for_opencv_ignores_it(tmp_path):
    skewed = Camera.make(K_CAMERA + [[0, 1.5, 0], [0, 0, 0], [0, 0, 0]], [], (1280, 1024), np.eye(4))
    with pytest.raises(InputError, match=r"camera A: has a skew of 1\.5 px; expected no skew"):
        write_opencv_rig(Rig({"A": skewed}), tmp_path / "rig.yml")
