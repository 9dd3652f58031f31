"""Cameras against OpenCV and against themselves; the rig's file; what a rig's file may not hold."""

import copy
import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planish import geometry
from planish.errors import InputError
from planish.rig import Camera, Rig
from planish.rig.exchange.opencv import read_opencv_rig

#: OpenCV computes in float64 as we do: only rounding may differ [px].
OPENCV_TOLERANCE_PX = 1e-8
#: The inverse distortion stops at 1e-13 in normalised coordinates, times a focal length of some 1000 px.
ROUND_TRIP_TOLERANCE_PX = 1e-8

K = np.array([[1400.0, 0.0, 801.3], [0.0, 1410.0, 602.7], [0.0, 0.0, 1.0]])
SIZE_PX = (1600, 1200)
T = geometry.exp_se3([0.1, -0.3, 0.05, 30.0, -20.0, 800.0])

DISTORTIONS = {
    "none": [],
    "barrel": [-0.3, 0.08],
    "strong pincushion": [0.6, 0.0],
    "moustache": [-0.25, 0.3, 1e-3, -2e-3, 0.05],
    "rational": [0.3, 0.1, 1e-3, 2e-3, 0.05, 0.5, 0.05, 0.01],
    "thin prism": [-0.1, 0.02, 2e-3, -1e-3, 0.0, 0.0, 0.0, 0.0, 3e-3, -1e-3, -2e-3, 1e-3],
}


def camera_with(distortion, skew=0.0):
    padded = distortion + [0.0] * (4 - len(distortion) if 0 < len(distortion) < 4 else 0)
    return Camera.make(K + skew * np.outer([1, 0, 0], [0, 1, 0]), padded, SIZE_PX, T)


def points_in_view(camera, count=500, seed=0):
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.uniform(-0.55, 0.55, count), rng.uniform(-0.42, 0.42, count), np.ones(count)])
    return geometry.transform_points(geometry.invert(camera.T_camera_sensor), x * rng.uniform(300, 1500, (count, 1)))


@pytest.mark.parametrize("distortion", DISTORTIONS.values(), ids=DISTORTIONS.keys())
def test_a_camera_projects_as_opencv_does(distortion):
    camera = camera_with(distortion)
    points = points_in_view(camera)
    rotation, _ = cv2.Rodrigues(T[:3, :3])
    expected, _ = cv2.projectPoints(points, rotation, T[:3, 3], K, camera.distortion)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=OPENCV_TOLERANCE_PX)


@pytest.mark.parametrize("distortion", DISTORTIONS.values(), ids=DISTORTIONS.keys())
@pytest.mark.parametrize("skew", [0.0, 2.5])
def test_the_ray_through_a_projected_point_hits_the_point(distortion, skew):
    camera = camera_with(distortion, skew)
    points = points_in_view(camera)
    rays = camera.rays_sensor(camera.project(points))
    depth = geometry.transform_points(camera.T_camera_sensor, points)[:, 2:]
    np.testing.assert_allclose(camera.center_sensor + depth * rays, points, atol=1500 * 1e-10)


@given(
    st.tuples(st.floats(-0.3, 0.6), st.floats(0.0, 0.2), st.floats(-5e-3, 5e-3), st.floats(-5e-3, 5e-3)),
    st.floats(-0.5, 0.5),
    st.floats(-0.4, 0.4),
)
def test_pixels_survive_the_way_to_a_ray_and_back(distortion, x, y):
    camera = Camera.make(K, distortion, SIZE_PX, T)
    pixel = camera.project(geometry.transform_points(geometry.invert(T), np.array([[x, y, 1.0]]) * 700))
    point = camera.center_sensor + 900.0 * camera.rays_sensor(pixel)
    np.testing.assert_allclose(camera.project(point), pixel, atol=ROUND_TRIP_TOLERANCE_PX)


def test_points_behind_the_camera_have_no_pixel():
    camera = Camera.make(K, [], SIZE_PX, np.eye(4))
    pixels = camera.project(np.array([[0, 0, 500.0], [0, 0, -500.0], [1, 1, 0], [np.nan, 0, 1]]))
    np.testing.assert_array_equal(np.isnan(pixels), [[False] * 2, [True] * 2, [True] * 2, [True] * 2])


def test_a_pixel_beyond_the_range_of_the_distortion_has_no_ray():
    # r (1 - 0.5 r^2) has its maximum 0.544 at r = 0.816: nothing is imaged farther out.
    camera = Camera.make([[1000, 0, 0], [0, 1000, 0], [0, 0, 1]], [-0.5, 0, 0, 0], SIZE_PX, np.eye(4))
    rays = camera.rays_sensor(np.array([[500.0, 0.0], [600.0, 0.0]]))
    np.testing.assert_array_equal(np.isnan(rays[:, 0]), [False, True])


def test_project_and_rays_keep_the_shape_of_a_map_and_leave_the_input_alone():
    camera = camera_with(DISTORTIONS["barrel"])
    points = points_in_view(camera, 12).reshape(3, 4, 3)
    before = points.copy()
    pixels = camera.project(points)
    assert pixels.shape == (3, 4, 2)
    assert camera.rays_sensor(pixels).shape == (3, 4, 3)
    np.testing.assert_array_equal(points, before)


def make_rig():
    T_other = geometry.exp_se3([0.0, 0.35, 0.02, -540.0, 3.0, 90.0]) @ T
    names = tuple(f"{camera}.{key}" for camera in "AB" for key in ("fx", "cx", "rotation_x", "translation_z"))
    root = np.random.default_rng(3).normal(size=(len(names), len(names)))
    return Rig(
        {"A": camera_with(DISTORTIONS["barrel"]), "B": Camera.make(K, [], SIZE_PX, T_other)},
        Camera.make(K, [0.01, 0, 0, 0], (1280, 800), T),
        (root @ root.T + (root @ root.T).T) / 2,
        names,
    )


def assert_same_camera(a, b):
    np.testing.assert_array_equal(a.kernel_parameters, b.kernel_parameters)
    assert a.size_px == b.size_px


def test_a_rig_survives_its_file_bit_by_bit(tmp_path):
    rig = make_rig()
    rig.save(tmp_path / "rig.json")
    loaded = Rig.load(tmp_path / "rig.json")
    assert_same_camera(loaded.cameras["A"], rig.cameras["A"])
    assert_same_camera(loaded.cameras["B"], rig.cameras["B"])
    assert_same_camera(loaded.projector, rig.projector)
    np.testing.assert_array_equal(loaded.covariance, rig.covariance)
    assert loaded.covariance_parameters == rig.covariance_parameters


def test_a_rig_may_be_one_camera_alone(tmp_path):
    rig = Rig({"A": camera_with([])})
    rig.save(tmp_path / "rig.json")
    loaded = Rig.load(tmp_path / "rig.json")
    assert loaded.projector is None
    assert loaded.covariance is None
    assert loaded.other("A") is None


def test_another_sensor_frame_changes_no_pixel():
    rig = make_rig()
    moved = rig.in_frame_of("B")
    np.testing.assert_array_equal(moved.cameras["B"].T_camera_sensor, np.eye(4))
    points = points_in_view(rig.cameras["A"])
    points_b = geometry.transform_points(rig.cameras["B"].T_camera_sensor, points)
    for before, after in [(rig.cameras["A"], moved.cameras["A"]), (rig.projector, moved.projector)]:
        np.testing.assert_allclose(after.project(points_b), before.project(points), atol=1e-7)


def test_the_kernels_get_all_numbers_of_a_camera_in_the_documented_order():
    camera = camera_with(DISTORTIONS["thin prism"], skew=1.5)
    expected = np.r_[1400, 1410, 801.3, 602.7, 1.5, camera.distortion, T[:3, :3].ravel(), T[:3, 3]]
    np.testing.assert_array_equal(camera.kernel_parameters, expected)


def correlate(content, value):
    """Set the correlation of the first two parameters."""
    matrix = content["covariance"]["matrix"]
    matrix[0][1] = matrix[1][0] = value * (matrix[0][0] * matrix[1][1]) ** 0.5


WRONG = {
    "unknown key": (lambda c: c.update(colour="red"), "unknown key 'colour'"),
    "unknown key of a camera": (lambda c: c["cameras"]["A"].update(fov=1), "unknown key 'cameras.A.fov'"),
    "other schema": (lambda c: c.update(schema="planish.rig/2"), "'schema' is 'planish.rig/2'"),
    "no camera A": (lambda c: c["cameras"].pop("A"), "key 'cameras.A' is missing"),
    "ragged K": (lambda c: c["cameras"]["A"].update(K=[[1, 2], [3]]), "A.K"),
    "K without its last row": (lambda c: c["cameras"]["B"].update(K=[[1, 0, 0], [0, 1, 0], [0, 0, 0]]), "B.K"),
    "negative focal length": (lambda c: c["cameras"]["A"]["K"][0].__setitem__(0, -5), "A.K"),
    "three coefficients": (lambda c: c["cameras"]["A"].update(distortion=[1, 2, 3]), "A.distortion"),
    "empty image": (lambda c: c["cameras"]["A"].update(size_px=[0, 5]), "A.size_px"),
    "scaled rotation": (lambda c: c["cameras"]["A"]["T_camera_sensor"][0].__setitem__(0, 2.0), "A.T_camera_sensor"),
    "covariance of other size": (
        lambda c: c["covariance"]["parameters"].pop(),
        "found 8 rows of 8 numbers; expected 7",
    ),
    "parameter twice": (lambda c: c["covariance"]["parameters"].__setitem__(1, "A.fx"), "found 'A.fx' twice"),
    "negative variance": (lambda c: c["covariance"]["matrix"][0].__setitem__(0, -1.0), "the variance of A.fx is -1"),
    "asymmetric": (lambda c: c["covariance"]["matrix"][0].__setitem__(1, 99.0), "not symmetric: A.fx and A.cx have 99"),
    "correlation above 1": (lambda c: correlate(c, 1.01), "that of A.cx and A.fx (1.01)"),
    "unknown parameter": (lambda c: c["covariance"]["parameters"].__setitem__(0, "A.f"), "found 'A.f'"),
    "parameter of no device": (
        lambda c: c["covariance"]["parameters"].__setitem__(0, "C.fx"),
        "devices A, B, projector",
    ),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_rig_file_is_refused_with_its_name_and_the_key(tmp_path, change, message):
    content = copy.deepcopy(make_rig().to_json())
    change(content)
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        Rig.load(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)


def test_nan_in_a_rig_file_is_refused(tmp_path):
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(make_rig().to_json()).replace("801.3", "NaN"))
    with pytest.raises(InputError, match=r"cameras\.A\.K"):
        Rig.load(path)


def write_opencv(path, **matrices):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, matrix in matrices.items():
        file.write(name, np.asarray(matrix, float))
    file.release()
    return path


def test_an_opencv_calibration_maps_points_of_the_left_camera_into_the_right(tmp_path):
    R, t = geometry.exp_so3([0.01, 0.2, 0.0]), np.array([[-217.0], [1.0], [20.0]])
    intrinsic = write_opencv(tmp_path / "in.yml", M1=K, D1=np.zeros((1, 5)), M2=K, D2=[[-0.1, 0, 0, 0, 0]])
    rig = read_opencv_rig([intrinsic, write_opencv(tmp_path / "ex.yml", R=R, T=t)], SIZE_PX).rig
    np.testing.assert_array_equal(rig.cameras["A"].T_camera_sensor, np.eye(4))
    x = np.array([10.0, 20.0, 900.0])
    np.testing.assert_allclose(
        geometry.transform_points(rig.cameras["B"].T_camera_sensor, x), R @ x + t[:, 0], atol=1e-10
    )
    assert rig.cameras["B"].distortion[0] == -0.1


@pytest.mark.parametrize("text", ["", "hello", "%YAML:1.0\n---\nM1: 3\n", "<?xml version='1.0'?><opencv_storage><a>"])
def test_a_file_that_opencv_cannot_read_is_refused_with_its_name(tmp_path, text):
    path = tmp_path / "calibration.yml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"calibration\.yml"):
        read_opencv_rig([path], SIZE_PX)


@pytest.mark.parametrize(
    ("changed", "named"),
    [({"R": np.eye(2)}, "R"), ({"T": np.zeros(2)}, "T"), ({"R": 2 * np.eye(3)}, "B.T_camera"), ({"M2": K[:2]}, "B.K")],
)
def test_an_opencv_matrix_of_wrong_form_is_refused_with_its_name(tmp_path, changed, named):
    good = {"M1": K, "D1": np.zeros(5), "M2": K, "D2": np.zeros(5), "R": np.eye(3), "T": np.ones(3)}
    path = write_opencv(tmp_path / "all.yml", **{**good, **changed})
    with pytest.raises(InputError, match=rf"all\.yml: {named}"):
        read_opencv_rig([path], SIZE_PX)


def test_a_missing_opencv_matrix_is_named(tmp_path):
    path = write_opencv(tmp_path / "all.yml", M1=K, D1=np.zeros(5), M2=K, D2=np.zeros(5), R=np.eye(3))
    with pytest.raises(InputError, match="no matrix named T or Tlr"):
        read_opencv_rig([path], SIZE_PX)


def test_a_covariance_of_very_different_units_is_checked_in_each(tmp_path):
    # 0.05 px and 10 microrad: against the largest variance of all, the wrong sign of the small one would be rounding.
    names = ("A.fx", "B.rotation_x", "B.rotation_y")
    matrix = np.diag([2.5e-3, 1e-10, 1e-10])
    rig = Rig(make_rig().cameras, None, matrix, names)
    rig.save(tmp_path / "rig.json")
    np.testing.assert_array_equal(Rig.load(tmp_path / "rig.json").covariance, matrix)
    matrix[1, 2] = matrix[2, 1] = 1.1e-10
    Rig(rig.cameras, None, matrix, names).save(tmp_path / "wrong.json")
    with pytest.raises(InputError, match=r"B\.rotation_[xy] and B\.rotation_[xy] \(1\.1\)"):
        Rig.load(tmp_path / "wrong.json")


def test_the_frame_of_a_camera_that_the_rig_has_not_is_refused():
    with pytest.raises(InputError, match="frame: found 'C'; expected a camera of the rig: A, B"):
        make_rig().in_frame_of("C")
