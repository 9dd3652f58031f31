"""Calibrations by MATLAB: conventions by hand, all versions of the file, what is no struct, and the way back."""

import numpy as np
import pytest
from scipy.io import loadmat

from mat_files import write_v5, write_v5_object, write_v73, write_v73_object
from planish.errors import InputError
from planish.geometry import compose, exp_se3, exp_so3
from planish.rig import Camera, Rig
from planish.rig.exchange.matlab import read_matlab_rig
from planish.rig.exchange.matlab_export import write_matlab_rig

#: Row vectors: [x y 1] = [X Y Z] IntrinsicMatrix.
INTRINSIC_MATRIX = np.array([[1000.0, 0.0, 0.0], [2.0, 1100.0, 0.0], [321.0, 241.0, 1.0]])
#: A quarter turn for row vectors: (1, 0, 0) R = (0, 1, 0).
ROTATION_OF_CAMERA_2 = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TRANSLATION_OF_CAMERA_2 = np.array([[10.0, 20.0, 30.0]])


def camera_struct(**changes):
    """The fields of toStruct(cameraParams) before R2022b, in MATLAB's order; None leaves one out."""
    fields = {
        "RadialDistortion": [-0.2, 0.1],
        "TangentialDistortion": [0.001, -0.002],
        "ImageSize": [480.0, 640.0],
        "WorldPoints": np.zeros((54, 2)),
        "WorldUnits": "mm",
        "EstimateSkew": np.array([[True]]),
        "NumRadialDistortionCoefficients": 2.0,
        "EstimateTangentialDistortion": np.array([[True]]),
        "RotationVectors": np.zeros((0, 3)),
        "TranslationVectors": np.zeros((0, 3)),
        "ReprojectionErrors": np.zeros((0, 2)),
        "IntrinsicMatrix": INTRINSIC_MATRIX,
        "Version": {"Name": "Computer Vision Toolbox", "Version": "10.0", "Release": "(R2021a)", "Date": "14-Nov-2020"},
        **changes,
    }
    return {name: value for name, value in fields.items() if value is not None}


def new_camera_struct(**changes):
    """Since R2022b."""
    return camera_struct(IntrinsicMatrix=None, K=INTRINSIC_MATRIX.T, **changes)


def stereo_struct(first=None, second=None, **changes):
    fields = {
        "CameraParameters1": first or camera_struct(),
        "CameraParameters2": second or camera_struct(RadialDistortion=[-0.3, 0.2, 0.05]),
        "RotationOfCamera2": ROTATION_OF_CAMERA_2,
        "TranslationOfCamera2": TRANSLATION_OF_CAMERA_2,
        "Version": {"Name": "Computer Vision Toolbox"},
        "RectificationParams": {"Initialized": np.array([[False]])},
        **changes,
    }
    return {name: value for name, value in fields.items() if value is not None}


@pytest.fixture(params=[write_v5, write_v73], ids=["v7", "v7.3"])
def write(request):
    return request.param


def test_the_first_pixel_moves_and_row_vectors_become_columns(tmp_path, write):
    imported = read_matlab_rig(write(tmp_path / "c.mat", stereoParams=stereo_struct()))
    rig = imported.rig
    # MATLAB's (321, 241) with its first pixel at (1, 1) is (320, 240) with the first pixel at (0, 0).
    np.testing.assert_array_equal(rig.cameras["A"].K, [[1000, 2, 320], [0, 1100, 240], [0, 0, 1]])
    assert rig.cameras["A"].project(np.array([0.0, 0.0, 500.0])) == pytest.approx([320, 240])
    assert rig.cameras["A"].size_px == (640, 480)
    # [1 0 0] R + [10 20 30] = [0 1 0] + [10 20 30].
    assert rig.cameras["B"].T_camera_sensor @ [1, 0, 0, 1] == pytest.approx([10, 21, 30, 1])
    np.testing.assert_array_equal(rig.cameras["A"].T_camera_sensor, np.eye(4))
    np.testing.assert_array_equal(rig.cameras["A"].distortion[:6], [-0.2, 0.1, 0.001, -0.002, 0, 0])
    np.testing.assert_array_equal(rig.cameras["B"].distortion[:6], [-0.3, 0.2, 0.001, -0.002, 0.05, 0])
    assert "start at (1, 1): principal points moved by -1" in imported.notes[0]
    assert any("RotationOfCamera2 multiplies row vectors" in note for note in imported.notes)


@pytest.mark.parametrize(
    "pose",
    [
        {"A": compose(ROTATION_OF_CAMERA_2.T, TRANSLATION_OF_CAMERA_2)},
        {"R": ROTATION_OF_CAMERA_2.T, "Translation": TRANSLATION_OF_CAMERA_2},
        compose(ROTATION_OF_CAMERA_2.T, TRANSLATION_OF_CAMERA_2),
    ],
    ids=["A", "R and Translation", "matrix"],
)
def test_the_fields_since_r2022b_say_the_same(tmp_path, write, pose):
    old = read_matlab_rig(write(tmp_path / "old.mat", s=stereo_struct()))
    struct = stereo_struct(
        new_camera_struct(), new_camera_struct(RadialDistortion=[-0.3, 0.2, 0.05]),
        RotationOfCamera2=None, TranslationOfCamera2=None, PoseCamera2=pose,
    )  # fmt: skip
    new = read_matlab_rig(write(tmp_path / "new.mat", s=struct))
    for name in "AB":
        np.testing.assert_array_equal(new.rig.cameras[name].kernel_parameters, old.rig.cameras[name].kernel_parameters)
    assert new.notes[1:] == ("K as it stands", "PoseCamera2 maps points of camera 1 into camera 2: as it stands")


def test_six_radial_terms_are_the_rational_model(tmp_path, write):
    struct = new_camera_struct(RadialDistortion=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    camera = read_matlab_rig(write(tmp_path / "c.mat", cameraParams=struct)).rig.cameras["A"]
    # OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6.
    np.testing.assert_array_equal(camera.distortion[:8], [0.1, 0.2, 0.001, -0.002, 0.3, 0.4, 0.5, 0.6])


@pytest.mark.parametrize(
    ("unit", "scale"), [("mm", 1), ("millimeters", 1), ("centimeters", 10), ("m", 1000), ("inches", 25.4)]
)
def test_lengths_become_millimetres(tmp_path, unit, scale):
    camera = camera_struct(WorldUnits=unit)
    imported = read_matlab_rig(write_v5(tmp_path / "c.mat", s=stereo_struct(camera, camera)))
    assert imported.rig.cameras["B"].T_camera_sensor[:3, 3] == pytest.approx(scale * np.array([10, 20, 30]))
    assert any("WorldUnits" in note for note in imported.notes) == (scale != 1)


def test_an_image_size_that_the_file_does_not_tell_must_be_given(tmp_path, write):
    path = write(tmp_path / "c.mat", cameraParams=camera_struct(ImageSize=np.zeros((0, 2))))
    with pytest.raises(InputError, match=r"size is not in the calibration.*--size"):
        read_matlab_rig(path)
    assert read_matlab_rig(path, (640, 480)).rig.cameras["A"].size_px == (640, 480)
    path = write(tmp_path / "d.mat", cameraParams=camera_struct())
    with pytest.raises(InputError, match="calibrated with 640 x 480 px; expected 1280 x 960"):
        read_matlab_rig(path, (1280, 960))


def test_of_several_calibrations_one_must_be_named(tmp_path, write):
    path = write(tmp_path / "c.mat", left=camera_struct(), right=new_camera_struct(), note="shift 2", n=[1.0, 2.0])
    with pytest.raises(InputError, match=r"several calibrations: left, right; expected .*--variable"):
        read_matlab_rig(path)
    assert "'right'" in read_matlab_rig(path, variable="right").notes[0]
    with pytest.raises(InputError, match="no variable 'middle'; expected one of"):
        read_matlab_rig(path, variable="middle")
    with pytest.raises(InputError, match="no calibration among the variables note"):
        read_matlab_rig(path, variable="note")


@pytest.mark.parametrize("write_object", [write_v5_object, write_v73_object], ids=["v7", "v7.3"])
@pytest.mark.parametrize(
    ("name", "class_name", "expected"),
    [
        ("stereoParams", "stereoParameters", r"s = toStruct\(stereoParams\); save\('x.mat', 's'\)"),
        ("session", "vision.internal.calibration.tool.Session", r"s = toStruct\(session.CameraParameters\)"),
        ("fisheyeParams", "fisheyeParameters", "a fisheye model; expected the pinhole model"),
    ],
)
def test_an_object_of_a_class_is_refused_with_the_way_out(tmp_path, write_object, name, class_name, expected):
    path = write_object(tmp_path / "object.mat", name, class_name)
    with pytest.raises(InputError, match=expected) as caught:
        read_matlab_rig(path)
    assert caught.value.subject == f"{path}: {name}"


def test_the_object_made_here_is_what_scipy_reads_of_one_by_matlab(tmp_path):
    content = loadmat(write_v5_object(tmp_path / "CameraParams.mat", "cameraParams", "cameraParameters"))
    (item,) = content["None"]
    # Printed in https://stackoverflow.com/q/66040231, of a file by MATLAB R2019a.
    assert [item[0], item[1], item[2]] == [b"cameraParams", b"MCOS", b"cameraParameters"]
    assert item[3].tolist() == [[3707764736], [2], [1], [1], [1], [1]]
    assert content["__function_workspace__"].dtype == np.uint8


@pytest.mark.parametrize(
    ("struct", "words"),
    [
        (stereo_struct(camera_struct(WorldUnits="parsec")), "WorldUnits: found 'parsec'; expected mm, cm, m or inches"),
        (stereo_struct(camera_struct(WorldUnits="cm")), "WorldUnits of the two cameras differ"),
        (stereo_struct(RotationOfCamera2=None), "no field 'RotationOfCamera2' or 'PoseCamera2'"),
        (stereo_struct(TranslationOfCamera2=[1.0, 2.0]), "TranslationOfCamera2: found"),
        (stereo_struct(RotationOfCamera2=2 * ROTATION_OF_CAMERA_2), "rigid transform"),
        (camera_struct(RadialDistortion=[1.0]), "RadialDistortion: found 1 coefficients"),
        (camera_struct(RadialDistortion=None), "no field 'RadialDistortion'"),
        (camera_struct(TangentialDistortion="none"), "TangentialDistortion: found str; expected numbers"),
        (camera_struct(IntrinsicMatrix=INTRINSIC_MATRIX.T), "camera matrix"),
        ({"Intrinsics": {"MappingCoefficients": [800.0, 0, 0, 0]}}, "a fisheye model"),
        ({"fx": 1.0}, r"no calibration among the variables s.*toStruct"),
    ],
)
def test_a_struct_that_is_not_understood_is_refused_by_name(tmp_path, write, struct, words):
    with pytest.raises(InputError, match=words) as caught:
        read_matlab_rig(write(tmp_path / "c.mat", s=struct))
    assert caught.value.subject.startswith(str(tmp_path / "c.mat"))


@pytest.mark.parametrize("content", [b"", b"MATLAB 5.0 MAT-file" + b" " * 200, b"PK\3\4" * 100, b"\x89HDF\r\n\x1a\n"])
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / "c.mat").write_bytes(content)
    with pytest.raises(InputError, match=r"c\.mat: (is damaged or no MAT-file|no calibration)"):
        read_matlab_rig(tmp_path / "c.mat")
    with pytest.raises(InputError, match="no such file"):
        read_matlab_rig(tmp_path / "missing.mat")


def stereo_rig(distortion=(-0.2, 0.1, 1e-3, -2e-3), skew=0.0, sensor=(0.0,) * 6):
    K = [[1000.0, skew, 320.0], [0, 1100.0, 240.0], [0, 0, 1]]
    T_A = exp_se3(sensor)
    T_B = compose(exp_so3([0.02, -0.4, 0.01]), [-200.0, 3.0, 40.0]) @ T_A
    return Rig({"A": Camera.make(K, distortion, (640, 480), T_A), "B": Camera.make(K, [], (800, 600), T_B)})


def test_what_is_written_is_the_struct_that_matlab_reads(tmp_path):
    rig = stereo_rig(skew=2.0)
    assert write_matlab_rig(rig, tmp_path / "rig.mat") == ()
    struct = loadmat(tmp_path / "rig.mat", simplify_cells=True)["stereoParams"]
    first = struct["CameraParameters1"]
    np.testing.assert_array_equal(first["IntrinsicMatrix"], INTRINSIC_MATRIX)
    np.testing.assert_array_equal(first["ImageSize"], [480, 640])
    np.testing.assert_array_equal(first["RadialDistortion"], [-0.2, 0.1])
    assert (first["EstimateSkew"], first["NumRadialDistortionCoefficients"], first["WorldUnits"]) == (1, 2, "mm")
    point = np.array([10.0, -20.0, 900.0])
    expected = rig.cameras["B"].T_camera_sensor[:3, :3] @ point + rig.cameras["B"].T_camera_sensor[:3, 3]
    np.testing.assert_allclose(point @ struct["RotationOfCamera2"] + struct["TranslationOfCamera2"], expected)
    # stereoParameters(struct) asks for it.
    assert struct["RectificationParams"]["Initialized"] == 0


def test_the_same_rig_gives_the_same_bytes(tmp_path):
    for name in ("a.mat", "b.mat"):
        write_matlab_rig(stereo_rig(), tmp_path / name)
    assert (tmp_path / "a.mat").read_bytes() == (tmp_path / "b.mat").read_bytes()
    assert b"planish" in (tmp_path / "a.mat").read_bytes()[:116]


def test_rational_terms_are_written_with_a_word_and_thin_prisms_are_not(tmp_path):
    rational = Rig({"A": stereo_rig([0.3, 0.1, 1e-3, 2e-3, 0.05, 0.5, 0.05, 0.01]).cameras["A"]})
    (note,) = write_matlab_rig(rational, tmp_path / "rig.mat")
    assert "camera A: rational distortion" in note
    loaded = read_matlab_rig(tmp_path / "rig.mat").rig
    np.testing.assert_array_equal(loaded.cameras["A"].distortion, rational.cameras["A"].distortion)
    prism = stereo_rig([0.1, 0, 0, 0, 0, 0, 0, 0, 1e-3, 0, 0, 2e-3])
    with pytest.raises(InputError, match=r"camera A: has distortion s1, s4; expected radial and tangential"):
        write_matlab_rig(prism, tmp_path / "prism.mat")
    assert not (tmp_path / "prism.mat").exists()


def test_a_projector_is_refused_unless_left_out(tmp_path):
    pair = stereo_rig(sensor=(0.1, 0, 0, 5.0, 0, 0))
    rig = Rig(pair.cameras, pair.cameras["B"], np.eye(1), ("A.fx",))
    with pytest.raises(InputError, match=r"the rig has A, B, projector; expected .*--devices"):
        write_matlab_rig(rig, tmp_path / "rig.mat")
    with pytest.raises(InputError, match="MATLAB knows no projector"):
        write_matlab_rig(rig, tmp_path / "rig.mat", ("A", "projector"))
    lost = write_matlab_rig(rig, tmp_path / "rig.mat", ("A", "B"))
    assert [note.partition(":")[2].strip()[:20] for note in lost] == [
        "projector",
        "the covariance of 1 ",
        "the sensor frame; it",
    ]
