"""The registered cloud: what other programs read from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData

import registered
from planish.errors import InputError
from planish.files.cloud import intensity, write_registered
from planish.geometry import transform_points
from planish.registration.result import Group


@pytest.fixture(scope="module")
def run():
    items, _ = registered.prepared()
    result, _ = registered.registration()
    return result, items


def test_points_normals_intensity_and_index_survive_the_file(run, tmp_path):
    result, measurements = run
    (path,) = write_registered(tmp_path, result, measurements)
    vertices = PlyData.read(path)["vertex"]
    for index, placed in enumerate(result.measurements[:3]):
        item = measurements[placed.name].measurement
        own = vertices["measurement"] == index
        points = np.stack([vertices[k][own] for k in "xyz"], -1)
        expected = transform_points(placed.T_world_measurement, item.points_sensor[item.valid])
        assert np.array_equal(points, expected)
        assert np.array_equal(vertices["intensity"][own], intensity(item)[item.valid])
        normals = np.stack([vertices[f"n{k}"][own] for k in "xyz"], -1)
        to_camera = transform_points(placed.T_world_measurement, item.camera.center_sensor) - points
        assert (np.einsum("ki,ki->k", normals, to_camera) > 0).mean() > 0.98
        lengths = np.linalg.norm(normals, axis=1)
        assert np.allclose(lengths[lengths > 0], 1, atol=1e-5)


def test_the_header_says_unit_and_names(run, tmp_path):
    write_registered(tmp_path, *run)
    comments = PlyData.read(tmp_path / "registered.ply").comments
    assert "units mm" in comments
    assert "group 0, world = sensor frame of left" in comments
    assert "measurement 1 = middle" in comments


def test_a_step_thins_the_cloud_in_both_directions(run, tmp_path):
    result, measurements = run
    counts = []
    for step in (1, 3):
        (path,) = write_registered(tmp_path, result, measurements, step)
        counts.append(len(PlyData.read(path)["vertex"].data))
    assert counts[0] / counts[1] == pytest.approx(9, rel=0.05)
    with pytest.raises(InputError, match="step_px"):
        write_registered(tmp_path, result, measurements, 0)


def test_groups_without_a_common_frame_go_to_files_of_their_own(run, tmp_path):
    result, measurements = run
    moved = replace(result.measurements[2], group=1)
    result = replace(result, measurements=(*result.measurements[:2], moved, result.measurements[3]))
    paths = write_registered(tmp_path, result, measurements)
    assert [p.name for p in paths] == ["registered.ply", "registered_group1.ply"]
    assert set(PlyData.read(paths[0])["vertex"]["measurement"]) == {0, 1}
    assert set(PlyData.read(paths[1])["vertex"]["measurement"]) == {2, 3}


def test_a_measurement_that_stands_alone_is_written_too(run, tmp_path):
    result, measurements = run
    alone = replace(result, groups=(Group(1, result.measurements[3].name),), measurements=result.measurements[3:])
    (path,) = write_registered(tmp_path, alone, measurements)
    assert len(PlyData.read(path)["vertex"].data) == measurements[alone.measurements[0].name].measurement.valid.sum()
