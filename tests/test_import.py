"""Importing the measurements of other scanners."""

import sys

import cv2
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from planish.cli import main
from planish.errors import InputError
from planish.geometry import transform_points
from planish.measurement import Measurement
from planish.rig import Rig, write_rig
from planish.sensing.imported.measurement import import_measurement
from sequences import plane_points, small_rig
from test_measure_command import refused

NOISE_MM = 0.1
#: Sigma from a few dozen residuals in a window scatters by 10 %, its mean hardly.
SIGMA_RELATIVE = 0.1


def image(seed=0):
    return np.random.default_rng(seed).integers(80, 120, (150, 200)).astype(np.uint8)


def along_rays(camera, points, noise_mm, seed=1):
    rays = points - camera.center_sensor
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return points + np.random.default_rng(seed).normal(0, noise_mm, (*points.shape[:-1], 1)) * rays


def write_ply(path, points, text=False):
    vertex = np.array([tuple(p) for p in points], dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(vertex, "vertex")], text=text).write(str(path))


def distance_error(m, truth):
    center = m.camera.center_sensor
    return np.linalg.norm(m.points_sensor - center, axis=-1) - np.linalg.norm(truth - center, axis=-1)


def test_an_organised_cloud_keeps_its_points_and_gets_its_own_noise():
    rig = small_rig()
    truth = plane_points(rig.cameras["A"])
    points = along_rays(rig.cameras["A"], truth, NOISE_MM)
    points[40:60, 50:70] = np.nan
    m = import_measurement("scan", points.reshape(-1, 3), image(), rig)
    assert np.array_equal(m.valid, np.isfinite(points[..., 0]))
    assert np.abs(m.points_sensor - points)[m.valid].max() < 1e-4
    assert np.median(m.sigma_mm[m.valid]) == pytest.approx(NOISE_MM, rel=SIGMA_RELATIVE)
    assert (m.resampled, m.texture_views, list(m.rig.cameras), m.rig.projector) == (False, ("A",), ["A"], None)
    assert m.correspondence_px is None
    assert m.views["A"].mean is None
    assert np.array_equal(m.views["A"].white, image())


def test_an_unorganised_cloud_is_rendered_onto_the_rays_of_the_pixels():
    rig = small_rig()
    a = rig.cameras["A"]
    # Points of the plane where no pixel's ray meets it: on a grid of the plane, finer than the pixels.
    x, y = np.meshgrid(np.arange(-190, 190, 1.3), np.arange(-140, 140, 1.3))
    truth = np.stack([x, y, 0.1 * x - 0.05 * y], -1).reshape(-1, 3)
    m = import_measurement("scan", along_rays(a, truth, NOISE_MM), image(), rig)
    assert m.resampled
    v, u = np.nonzero(m.valid)
    assert len(v) > 10_000
    assert np.abs(a.project(m.points_sensor[v, u]) - np.stack([u, v], -1)).max() < 1e-3
    error = distance_error(m, plane_points(a))[m.valid]
    assert 1.4826 * np.median(np.abs(error)) < NOISE_MM
    assert np.std(error / m.sigma_mm[m.valid]) < 2.5
    assert np.median(np.abs(error) / m.sigma_mm[m.valid]) == pytest.approx(0.6745, rel=0.25)


def test_of_two_surfaces_the_nearer_one_is_rendered():
    rig = small_rig()
    x, y = (np.ravel(g) for g in np.meshgrid(np.arange(-150, 150, 1.3), np.arange(-100, 100, 1.3)))
    near = np.stack([x, y, np.full_like(x, 60.0)], -1)
    far = np.stack([x * 1.4, y * 1.4, np.full_like(x, -60.0)], -1)
    m = import_measurement("scan", np.concatenate([far, near]), image(), rig)
    middle = m.points_sensor[65:85, 90:110, 2]
    assert np.abs(middle - 60).max() < 1e-2


def test_gaps_of_an_unorganised_cloud_stay_gaps():
    rig = small_rig()
    x, y = (np.ravel(g) for g in np.meshgrid(np.arange(-150, 150, 1.3), np.arange(-100, 100, 1.3)))
    hole = np.hypot(x, y) < 40
    points = np.stack([x, y, 0 * x], -1)[~hole]
    m = import_measurement("scan", points, image(), rig)
    truth = plane_points(rig.cameras["A"], (0.0, 0.0))
    inside = np.hypot(truth[..., 0], truth[..., 1]) < 36
    assert inside.sum() > 300
    assert not m.valid[inside].any()


def test_a_cloud_of_another_camera_is_refused():
    rig = small_rig()
    points = plane_points(rig.cameras["B"]).reshape(-1, 3)
    with pytest.raises(InputError, match="beside the rays of their pixels"):
        import_measurement("scan", points, image(), rig)


@pytest.fixture
def files(tmp_path):
    rig = small_rig()
    rig.save(tmp_path / "rig.json")
    cv2.imwrite(str(tmp_path / "image.png"), image())
    points = plane_points(rig.cameras["A"])
    points[0, :50] = 0.0
    write_ply(tmp_path / "cloud.ply", points.reshape(-1, 3))
    return tmp_path


def arguments(folder, **changed):
    names = {"cloud": "cloud.ply", "image": "image.png", "camera": "rig.json", "out": "scan.h5"} | changed
    return ["import", *(text for key, name in names.items() for text in (f"--{key}", str(folder / name)))]


def test_the_command_writes_a_measurement_and_takes_zeros_for_missing_points(files, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["planish", *arguments(files), "--name", "door"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code
    m = Measurement.load(files / "scan.h5")
    assert m.name == "door"
    assert not m.valid[0, :50].any()
    assert m.valid[5:-5, 5:-5].all()
    assert capsys.readouterr().out.startswith("door: ")


@pytest.mark.parametrize("name", ["camera.yml", "camera.mat"])
def test_the_camera_may_be_calibrated_by_opencv_or_matlab(files, monkeypatch, name):
    rig = Rig.load(files / "rig.json")
    camera = rig.cameras["A"]
    write_rig(rig, files / name, ("A",))
    # The frame of such a file is that of the camera.
    points = transform_points(camera.T_camera_sensor, plane_points(camera))
    write_ply(files / "cloud.ply", points.reshape(-1, 3))
    monkeypatch.setattr(sys, "argv", ["planish", *arguments(files, camera=name)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code
    assert Measurement.load(files / "scan.h5").valid[5:-5, 5:-5].all()


def test_the_command_reads_text_files_too(files, monkeypatch):
    write_ply(files / "cloud.ply", plane_points(Rig.load(files / "rig.json").cameras["A"]).reshape(-1, 3), text=True)
    monkeypatch.setattr(sys, "argv", ["planish", *arguments(files)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda f: (f / "cloud.ply").unlink(), ["cloud.ply", "no such file"]),
        (
            lambda f: (f / "cloud.ply").write_bytes((f / "cloud.ply").read_bytes()[:999]),
            ["cloud.ply", "cannot be read"],
        ),
        (lambda f: (f / "cloud.ply").write_text("hello"), ["cloud.ply", "cannot be read"]),
        (lambda f: write_ply(f / "cloud.ply", np.zeros((9, 3))), ["cloud.ply", "holds no point"]),
        (lambda f: write_ply(f / "cloud.ply", np.full((99, 3), 9e4)), ["cloud.ply", "seen by the camera"]),
        (lambda f: cv2.imwrite(str(f / "image.png"), image()[:-1]), ["image.png", "200 x 149", "200 x 150"]),
        (lambda f: (f / "image.png").unlink(), ["image.png", "no such file"]),
        (lambda f: (f / "rig.json").write_text("{}"), ["rig.json", "missing"]),
    ],
)
def test_bad_input_is_refused_with_the_file_and_the_reason(files, monkeypatch, capsys, damage, expected):
    damage(files)
    message = refused(monkeypatch, capsys, *arguments(files))
    for part in expected:
        assert part in message


def test_an_output_of_another_kind_is_refused(files, monkeypatch, capsys):
    assert ".h5" in refused(monkeypatch, capsys, *arguments(files, out="scan.ply"))
