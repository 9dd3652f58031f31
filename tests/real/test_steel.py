"""Bare steel plates with inter-reflection, read from shifted square waves and Gray code."""

import numpy as np
import pytest
from captures import measured, plane_spread

#: Figures of the data's README (plain decoder, no filter) and of the issue: valid share, spread [mm].
POINTS = 1_600_000
PATCHES = {
    "floor": ((1100, 1500), (1100, 1400), 0.999, 0.119),
    "right wall, upper": ((1180, 1380), (520, 720), 0.973, 0.073),
    "right wall, right": ((1700, 1900), (900, 1050), 1.000, 0.054),
}


@pytest.fixture(scope="module")
def steel():
    return measured("steel_corner_shiftline")


def test_enough_points_are_valid(steel):
    assert steel.valid.sum() >= POINTS


@pytest.mark.parametrize("name", PATCHES)
def test_a_patch_is_as_complete_and_as_flat_as_known(steel, name):
    (u0, u1), (v0, v1), share, spread = PATCHES[name]
    valid, points = steel.valid[v0:v1, u0:u1], steel.points_sensor[v0:v1, u0:u1]
    assert valid.mean() >= share
    assert plane_spread(points[valid]) <= spread


def test_neighbours_do_not_slip_by_a_fringe(steel):
    """A slip moves a point by about 10 mm: such a jump between two valid neighbours needs an edge of the part."""
    depth = steel.points_sensor[500:1400, 1000:2000, 2]
    jumps = np.abs(np.diff(depth, axis=1)) > 5
    assert jumps.sum() < 1e-5 * jumps.size


def test_organised_on_the_right_camera_the_same_surface_is_found(steel):
    right = measured("steel_corner_shiftline", organise_on="B", texture_views=("B",))
    assert right.valid.sum() >= 0.9 * steel.valid.sum()
    T_right_left = right.rig.cameras["B"].T_camera_sensor @ steel.rig.cameras["B"].T_camera_sensor
    v, u = (x[::101] for x in np.nonzero(steel.valid))
    there = np.round(steel.correspondence_px[v, u]).astype(int)
    point = right.points_sensor[there[:, 1], there[:, 0]]
    expected = steel.points_sensor[v, u] @ T_right_left[:3, :3].T + T_right_left[:3, 3]
    distance = (point - expected)[np.isfinite(point[:, 0])]
    # Half a pixel, 0.35 mm each, apart along the surface at most; the rows of the calibration are off by 0.75 px.
    assert np.median(np.linalg.norm(distance, axis=1)) < 0.5
