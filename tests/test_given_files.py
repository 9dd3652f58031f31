"""Files of known points, of a robot and of a part's surface: what they say, and clear words where they are wrong."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

import synthetic
from command_line import planish
from planish.errors import InputError
from planish.files.given import GivenFiles, read_fixed_surface, read_given, read_known_points, read_prior
from planish.geometry import exp_se3
from planish.registration.result import Registration

NAMES = ("m1", "m2")
HEADER = "frame,target,x_mm,y_mm,z_mm,sigma_mm\n"
POINTS = HEADER + "world,A,1,2,3,0.01\nworld,B,4,5,6,0.01\n\nm1,A,-1,0.5,600,0.02\nm2,A,7,8,900,0.02\n"


def test_known_points_are_read_by_frame_and_target(tmp_path):
    (tmp_path / "points.csv").write_text(POINTS, encoding="utf-8-sig")
    world, seen = read_known_points(tmp_path / "points.csv", NAMES)
    assert sorted(world) == ["A", "B"]
    np.testing.assert_array_equal(world["B"].point_mm, [4, 5, 6])
    assert sorted(seen) == ["m1", "m2"]
    assert seen["m1"][0].name == "A"
    np.testing.assert_array_equal(seen["m1"][0].point_mm, [-1, 0.5, 600])
    assert seen["m1"][0].sigma_mm == 0.02


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("line 1", "found nothing", "frame,target")),
        ("x,y\n", ("line 1", "found x,y")),
        (HEADER + "world,A,1,2,3\n", ("line 2", "5 values", "6")),
        (HEADER + "world,A,1,2,z,0.1\n", ("line 2", "'z'", "finite number")),
        (HEADER + "world,A,1,2,nan,0.1\n", ("line 2", "'nan'")),
        (HEADER + "world,A,1,2,3,0\n", ("line 2", "sigma_mm 0", "above 0")),
        (HEADER + "world,A,1,2,3,1\n\nm9,A,1,2,3,1\n", ("line 4", "'m9'", "'m1'")),
        (HEADER + "world,A,1,2,3,1\nworld,A,1,2,3,1\n", ("line 3", "'A' in 'world' again", "line 2")),
        (HEADER + "m1,A,1,2,3,1\n", ("line 2", "no global coordinates", "world,A")),
    ],
)
def test_a_wrong_file_of_known_points_is_refused_by_its_line(tmp_path, text, words):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_known_points(path, NAMES)
    for word in (str(path), *words):
        assert word in str(caught.value)


def test_a_measurement_called_like_the_global_frame_and_a_missing_file_are_refused(tmp_path):
    with pytest.raises(InputError, match="another name"):
        read_known_points(tmp_path / "points.csv", ("world", "m1"))
    with pytest.raises(InputError, match="cannot be read"):
        read_known_points(tmp_path / "points.csv", NAMES)


def prior(**changes):
    entry = {
        "name": "m1",
        "T_world_measurement": exp_se3([0, 0, 1, 5, 6, 7]).tolist(),
        "sigma_mm": 2.0,
        "sigma_deg": 0.1,
    }
    return {"schema": "planish.prior/1", "measurements": [{**entry, **changes}]}


def write(path, content):
    path.write_text(json.dumps(content))
    return path


def test_a_robots_transforms_are_read_with_their_noise(tmp_path):
    (name, item), *rest = read_prior(write(tmp_path / "prior.json", prior()), NAMES).items()
    assert (name, rest) == ("m1", [])
    np.testing.assert_allclose(np.diag(item.covariance), [np.radians(0.1) ** 2] * 3 + [4.0] * 3)
    np.testing.assert_array_equal(item.point_robot_mm, item.T_robot_measurement[:3, 3])
    C = np.diag([1e-6] * 3 + [1.0] * 3)
    stated = prior(sigma_mm=None, sigma_deg=None, covariance=C.tolist(), covariance_point_mm=[1, 2, 3])
    (item,) = read_prior(write(tmp_path / "prior.json", stated), NAMES).values()
    np.testing.assert_array_equal(item.covariance, C)
    np.testing.assert_array_equal(item.point_robot_mm, [1, 2, 3])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "m9"}, ("measurements.0", "'m9'")),
        ({"T_world_measurement": (2 * np.eye(4)).tolist()}, ("measurements.0.T_world_measurement", "rigid")),
        ({"sigma_mm": None}, ("either sigma_mm and sigma_deg, or covariance",)),
        ({"covariance": np.eye(6).tolist()}, ("no or two statements",)),
        ({"sigma_mm": None, "sigma_deg": None, "covariance": (-np.eye(6)).tolist()}, ("positive definite",)),
        ({"sigma_mm": -1}, ("sigma_mm",)),
        ({"speed": 1}, ("unknown key",)),
    ],
)
def test_a_wrong_file_of_a_robot_is_refused_by_its_key(tmp_path, changes, words):
    path = write(tmp_path / "prior.json", prior(**changes))
    with pytest.raises(InputError) as caught:
        read_prior(path, NAMES)
    for word in (str(path), *words):
        assert word in str(caught.value)


def test_a_surface_needs_something_that_says_where_it_lies(tmp_path):
    with pytest.raises(InputError, match="--prior or --known-points"):
        read_given(GivenFiles(fixed=tmp_path / "part.stl"), NAMES)


def test_meshes_are_read_and_what_is_none_is_named(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((100, 50, 20)).export(tmp_path / "box.stl")
    surface = read_fixed_surface(tmp_path / "box.stl")
    np.testing.assert_allclose(np.abs(surface.points).max(0), [50, 25, 10], atol=surface.pitch_mm)
    (tmp_path / "bad.stl").write_text("nothing")
    (tmp_path / "part.step").write_text("nothing")
    for name, word in (("bad.stl", "bad.stl"), ("part.step", "unknown format"), ("gone.stl", "no such file")):
        with pytest.raises(InputError, match=word):
            read_fixed_surface(tmp_path / name)


def test_a_cloud_without_faces_is_a_surface_too(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    x, y = np.meshgrid(np.arange(20.0), np.arange(30.0))
    trimesh.PointCloud(np.stack([x, y, 5 + 0 * x], -1).reshape(-1, 3)).export(tmp_path / "cloud.ply")
    surface = read_fixed_surface(tmp_path / "cloud.ply")
    assert len(surface.points) == 600
    np.testing.assert_allclose(np.abs(surface.normals[:, 2]), 1, atol=1e-6)


def test_without_trimesh_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "part.stl").write_text("")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(InputError, match=r"planish\[cad\]"):
        read_fixed_surface(tmp_path / "part.stl")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    path = tmp_path_factory.mktemp("measured") / "m1.h5"
    synthetic.measurement(np.eye(4), synthetic.raster(1, 0.02), scale=0.2, name="m1").save(path)
    return path


def test_the_command_refuses_wrong_files_with_2_and_takes_right_ones(measured, tmp_path):
    out = tmp_path / "out"
    (tmp_path / "points.csv").write_text(HEADER + "world,A,1,2,z,0.1\n")
    outcome = planish("register", measured, "--out", out, "--known-points", tmp_path / "points.csv")
    assert outcome.code == 2
    assert "line 2" in outcome.err
    assert not out.exists()
    robot = write(tmp_path / "prior.json", prior())
    options = ("--no-report", "--no-cloud", "--prior", robot)
    assert planish("register", measured, "--out", out, *options).code == 0
    (test,) = Registration.load(out / "registration.json").network.given
    assert (test.kind, test.measurement, test.used) == ("robot", "m1", True)
    assert (out / "network.h5").is_file()
