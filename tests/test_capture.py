"""The capture manifest and its images: what is read, and what is refused with which message."""

import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planish.errors import InputError
from planish.rig import Camera, Rig
from planish.sensing.capture.images import read_grey
from planish.sensing.capture.manifest import Capture, Manifest
from planish.sensing.patterns.entries import Gray, Phase

HEIGHT, WIDTH = 24, 32
SEQUENCE = [
    {"role": "white"},
    {"role": "black"},
    *({"role": "phase", "axis": "u", "period_px": 20, "step": k, "steps": 3, "sign": -1} for k in range(3)),
    {"role": "gray", "axis": "v", "bit": 0, "inverse": True, "cell_px": 10},
]


def images_of(camera):
    return [f"{camera}/{i:02d}.png" for i in range(len(SEQUENCE))]


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    for camera in "AB":
        (tmp_path / camera).mkdir()
        for name in images_of(camera):
            cv2.imwrite(str(tmp_path / name), rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8))
    K = [[50, 0, 16], [0, 50, 12], [0, 0, 1]]
    camera = Camera.make(K, [], (WIDTH, HEIGHT), np.eye(4))
    Rig({"A": camera, "B": camera}).save(tmp_path / "rig.json")
    write_manifest(tmp_path)
    return tmp_path


def manifest_content(**changes):
    images = {"A": images_of("A"), "B": images_of("B")}
    return {"schema": "planish.capture/1", "rig": "rig.json", "images": images, "sequence": SEQUENCE, **changes}


def write_manifest(folder, **changes):
    (folder / "capture.json").write_text(json.dumps(manifest_content(**changes)))


def test_a_capture_is_read_by_its_folder_or_its_manifest(folder):
    for path in (folder, folder / "capture.json"):
        capture = Capture.load(path)
        assert capture.name == folder.name
        assert capture.cameras == ("A", "B")
        assert [image.shape for image in capture.read_images("B")] == [(HEIGHT, WIDTH)] * len(SEQUENCE)
        assert set(capture.load_rig("A").cameras) == {"A", "B"}
    assert isinstance(capture.manifest.sequence[2], Phase)
    assert isinstance(capture.manifest.sequence[5], Gray)
    assert capture.manifest.sequence[2].sign == -1


def test_images_may_lie_in_another_folder_than_the_manifest(folder, tmp_path_factory):
    manifests = tmp_path_factory.mktemp("manifests")
    write_manifest(manifests, name="other")
    (manifests / "rig.json").write_text((folder / "rig.json").read_text())
    capture = Capture.load(manifests / "capture.json", folder)
    assert capture.name == "other"
    np.testing.assert_array_equal(
        capture.read_image("A", 3), cv2.imread(str(folder / "A/03.png"), cv2.IMREAD_GRAYSCALE)
    )


def test_a_single_camera_is_enough_for_a_capture(folder):
    write_manifest(folder, images={"A": images_of("A")})
    assert Capture.load(folder).cameras == ("A",)


def test_the_rig_of_opencv_files_gets_the_frame_of_the_organising_camera(folder):
    file = cv2.FileStorage(str(folder / "rig.yml"), cv2.FILE_STORAGE_WRITE)
    K = np.array([[50.0, 0, 16], [0, 50, 12], [0, 0, 1]])
    for name, matrix in {"M1": K, "D1": np.zeros(5), "M2": K, "D2": np.zeros(5)}.items():
        file.write(name, matrix)
    file.write("R", np.eye(3))
    file.write("T", np.array([-100.0, 0, 0]))
    file.release()
    write_manifest(folder, rig=["rig.yml"])
    rig = Capture.load(folder).load_rig("B")
    np.testing.assert_array_equal(rig.cameras["B"].T_camera_sensor, np.eye(4))
    np.testing.assert_array_equal(rig.cameras["A"].T_camera_sensor[:3, 3], [100, 0, 0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"exposure": 3}, "unknown key 'exposure'"),
        ({"sequence": [{"role": "white", "bit": 1}] + SEQUENCE[1:]}, "unknown key 'sequence.0.white.bit'"),
        ({"sequence": [{"role": "grey"}] + SEQUENCE[1:]}, "'sequence.0' has role 'grey'"),
        ({"sequence": [{"axis": "u"}] + SEQUENCE[1:]}, "'sequence.0' is {'axis': 'u'}"),
        ({"sequence": [{"role": "phase", "period_px": 20, "step": 4, "steps": 4}] + SEQUENCE[1:]}, "must be below"),
        ({"sequence": [{"role": "phase", "period_px": 0, "step": 0, "steps": 4}] + SEQUENCE[1:]}, "period_px"),
        ({"sequence": [{"role": "phase", "period_px": 9, "step": 0, "steps": 2}] + SEQUENCE[1:]}, "steps"),
        ({"sequence": SEQUENCE[:-1]}, "images.A names 6 images"),
        ({"images": {"A": images_of("A"), "B": ["one.png"]}}, "images.B names 1 images"),
        ({"images": {"A": images_of("A"), "C": []}}, "unknown key 'images.C'"),
        ({"schema": "planish.capture/9"}, "'schema' is 'planish.capture/9'"),
        ({"name": "a/b"}, "'name' is 'a/b'"),
        ({"projector_px": [1280, 0]}, "projector_px"),
        ({"mask": {"D": "x.png"}}, "mask"),
    ],
)
def test_a_wrong_manifest_is_refused_with_its_path_and_the_key(folder, changes, message):
    write_manifest(folder, **changes)
    with pytest.raises(InputError) as caught:
        Capture.load(folder)
    assert str(folder / "capture.json") in str(caught.value)
    assert message in str(caught.value)


def test_an_empty_folder_is_no_capture(tmp_path):
    with pytest.raises(InputError, match=r"capture\.json: cannot be read"):
        Capture.load(tmp_path)


@given(
    st.lists(
        st.sampled_from(["..", ".", "A", "a.png", "", "/", "\\", "~", "\0", "x" * 300, "ü"]), min_size=1, max_size=6
    ).map("/".join)
)
def test_no_name_in_a_manifest_reaches_outside_its_folder(tmp_path_factory, name):
    folder = tmp_path_factory.mktemp("outer") / "inner"
    folder.mkdir()
    (folder.parent / "a.png").write_bytes(b"secret")
    content = manifest_content(images={"A": [name] * len(SEQUENCE)})
    capture = Capture("c", folder / "capture.json", folder, Manifest.parse(content, "capture.json"))
    with pytest.raises(InputError) as caught:
        capture.read_image("A", 0)
    assert "secret" not in str(caught.value)
    if "a.png" in name:
        assert "cannot be decoded" not in str(caught.value)


@pytest.mark.parametrize("name", ["../a.png", "A/../../a.png", "/etc/hostname", "link.png"])
def test_names_that_leave_the_folder_are_refused_as_such(folder, name):
    (folder / "link.png").symlink_to("/etc/hostname")
    write_manifest(folder, images={"A": [name] * len(SEQUENCE)})
    with pytest.raises(InputError, match="leaves the folder"):
        Capture.load(folder).read_images("A")
    write_manifest(folder, rig="../rig.json")
    with pytest.raises(InputError, match="leaves the folder"):
        Capture.load(folder).load_rig("A")


def test_a_missing_image_and_a_missing_rig_are_named(folder):
    (folder / "B/03.png").unlink()
    with pytest.raises(InputError, match=r"B/03\.png: no such file"):
        Capture.load(folder).read_images("B")
    (folder / "rig.json").unlink()
    with pytest.raises(InputError, match=r"rig\.json: cannot be read"):
        Capture.load(folder).load_rig("A")


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((HEIGHT, WIDTH + 1), np.uint8), "33 x 24 px, 8 bit; expected 32 x 24 px, 8 bit like 00.png"),
        (np.zeros((HEIGHT, WIDTH), np.uint16), "32 x 24 px, 16 bit; expected 32 x 24 px, 8 bit like 00.png"),
    ],
)
def test_images_of_different_size_or_depth_are_refused(folder, image, message):
    cv2.imwrite(str(folder / "A/04.png"), image)
    with pytest.raises(InputError) as caught:
        Capture.load(folder).read_images("A")
    assert "A/04.png" in str(caught.value)
    assert message in str(caught.value)


def test_a_colour_image_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((5, 6, 3), np.uint8))
    with pytest.raises(InputError, match="3 channels"):
        read_grey(tmp_path / "a.png")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif"])
def test_a_truncated_image_is_refused_by_name(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (200, 300), np.uint8))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=rf"a\{suffix}: cannot be decoded"):
        read_grey(path)


def test_grey_values_of_8_and_16_bit_are_read_unchanged(tmp_path):
    for dtype in (np.uint8, np.uint16):
        image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (50, 60), dtype)
        cv2.imwrite(str(tmp_path / "a.png"), image)
        read = read_grey(tmp_path / "a.png")
        assert read.dtype == dtype
        np.testing.assert_array_equal(read, image)


def test_threads_do_not_change_the_order_of_the_images(folder):
    capture = Capture.load(folder)
    for one, many in zip(capture.read_images("A", threads=1), capture.read_images("A", threads=4), strict=True):
        np.testing.assert_array_equal(one, many)
