"""Calibrations written by OpenCV: two cameras, or a camera and a projector."""

import cv2
import numpy as np
import pytest

from planish.errors import InputError
from planish.geometry import exp_so3
from planish.rig.opencv import read_opencv_rig

K_CAMERA = np.array([[3452.4, 0, 587.2], [0, 3449.9, 521.4], [0, 0, 1]])
K_PROJECTOR = np.array([[3953.7, 0, 737.2], [0, 3893.3, 1357.8], [0, 0, 1]])
R, T = exp_so3([-0.08, 0.0, -0.01]), np.array([[85.7], [-630.5], [-100.8]])


def write(path, **matrices):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, matrix in matrices.items():
        storage.write(name, matrix)
    storage.release()
    return path


def projector_matrices(rotation="rotation"):
    return {
        "cam_int": K_CAMERA, "cam_dist": np.array([[-0.22, -0.87, -7e-4, -1.7e-3, 3.1]]),
        "proj_int": K_PROJECTOR, "proj_dist": np.array([[-0.017, -0.44, -9e-3, -0.021, 1.7]]),
        rotation: R, "translation": T,
    }  # fmt: skip


@pytest.mark.parametrize("suffix", ["xml", "yml"])
@pytest.mark.parametrize("rotation", ["rotation", "roration"])
def test_a_camera_and_a_projector_are_read(tmp_path, suffix, rotation):
    path = write(tmp_path / f"calibration.{suffix}", **projector_matrices(rotation))
    rig = read_opencv_rig([path], (1280, 1024), (2048, 1536))
    assert set(rig.cameras) == {"A"}
    assert (rig.cameras["A"].size_px, rig.projector.size_px) == ((1280, 1024), (2048, 1536))
    assert np.array_equal(rig.projector.K, K_PROJECTOR)
    assert rig.projector.distortion[:5] == pytest.approx([-0.017, -0.44, -9e-3, -0.021, 1.7])
    # x_projector = R x_camera + T, and the camera is the sensor frame; OpenCV's own projection is the judge.
    point = np.array([40.0, -30.0, 3500.0])
    expected = cv2.projectPoints(point[None], cv2.Rodrigues(R)[0], T, K_PROJECTOR, projector_matrices()["proj_dist"])[0]
    assert rig.projector.project(point) == pytest.approx(expected.ravel(), abs=1e-6)


def test_without_a_projector_matrix_two_cameras_are_read(tmp_path):
    path = write(tmp_path / "stereo.yml", M1=K_CAMERA, D1=np.zeros((1, 5)), M2=K_CAMERA, D2=np.zeros((1, 5)), R=R, T=T)
    rig = read_opencv_rig([path], (1280, 1024))
    assert set(rig.cameras) == {"A", "B"}
    assert rig.projector is None
    assert rig.cameras["B"].T_camera_sensor[:3, 3] == pytest.approx(T.ravel())


def test_a_projector_of_unknown_size_and_a_missing_matrix_are_named(tmp_path):
    path = write(tmp_path / "calibration.xml", **projector_matrices())
    with pytest.raises(InputError, match="projector_px"):
        read_opencv_rig([path], (1280, 1024))
    matrices = projector_matrices()
    del matrices["translation"]
    path = write(tmp_path / "less.xml", **matrices)
    with pytest.raises(InputError, match="no matrix named translation or T"):
        read_opencv_rig([path], (1280, 1024), (2048, 1536))
