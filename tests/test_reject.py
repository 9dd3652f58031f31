"""Rejection: edges, islands, volume and the projector as a third ray."""

import numpy as np
import pytest

from planish import _core
from planish.measurement import REJECTIONS
from planish.sensing.capture.manifest import Box
from planish.sensing.points.correspond import correspond
from planish.sensing.points.reject import RejectOptions, reject_edges, reject_points
from planish.sensing.points.triangulate import triangulate
from reference import sensing as reference
from sequences import plane_points, small_rig
from test_correspond import phase_map, plane_maps

OPTIONS = RejectOptions()


def slope(shape=(30, 60)):
    return np.tile(np.arange(shape[1]) * 0.9, (shape[0], 1)) + np.arange(shape[0])[:, None] * 0.05


def edges(position, sigma=0.01):
    result = reject_edges(phase_map(position, sigma), OPTIONS, 2)
    return (result.rejected >> REJECTIONS.index("mixed")) & 1 == 1


def test_the_pixels_beside_a_jump_are_rejected_and_no_others():
    position = slope()
    position[:, 30:] += 15
    expected = np.zeros(position.shape, bool)
    expected[:, 29:31] = True
    assert np.array_equal(edges(position), expected)


def test_a_jump_along_a_column_is_rejected_in_both_rows():
    position = slope()
    position[12:] += 15
    expected = np.zeros(position.shape, bool)
    expected[11:13] = True
    assert np.array_equal(edges(position), expected)


def test_a_pixel_that_mixes_two_surfaces_is_rejected():
    position = slope()
    position[:, 31:] += 30
    position[:, 30] += 14
    found = edges(position)
    assert found[:, 29:32].all()
    assert not np.delete(found, [29, 30, 31], axis=1).any()


@pytest.mark.parametrize("height_px", [0.2, 0.4])
def test_a_small_step_and_a_crease_are_kept(height_px):
    position = slope()
    position[:, 30:] += height_px
    position[:, 45:] += np.arange(15) * 0.8
    assert not edges(position).any()


def test_noise_makes_no_edges():
    position = slope((200, 300)) + np.random.default_rng(0).normal(0, 0.3, (200, 300))
    # A comparison at five standard deviations has 6e-7; each pixel takes part in about 16 of them.
    assert edges(position, 0.3).mean() < 1e-4


def test_edges_of_rows_equal_their_numpy_twin():
    rng = np.random.default_rng(3)
    position = (np.cumsum(rng.choice([0.8, 1.0, 1.2, 9.0], (1, 400), p=[0.3, 0.3, 0.3, 0.1]), 1)).astype(np.float32)
    position[0, rng.integers(0, 400, 30)] = np.nan
    maps = position, np.full_like(position, 1e-3), np.zeros(position.shape, np.uint16)
    found = _core.phase_edges(*maps, 1.0, 5.0, 4, 1)[2]
    assert np.array_equal(found[0] == 4, reference.edges_of_row(position[0], np.float32(1.0)))
    assert found.any()


def test_islands_equal_their_numpy_twin():
    rng = np.random.default_rng(4)
    depth = np.where(rng.random((40, 50)) < 0.6, 800.0, np.nan).astype(np.float32)
    depth[10:20, 10:30] += 30
    found = _core.islands(depth, np.full_like(depth, 1e-3), np.empty((0, 0), np.uint8), 0.005, 5.0, 12, 2)
    assert np.array_equal(found == 1, reference.small_islands(depth.astype(float), 0.005 * 800 + 0.007, 12))
    assert 0 < found.sum() < np.isfinite(depth).sum()


def test_grazing_points_equal_their_numpy_twin():
    rng = np.random.default_rng(6)
    # A cylinder's flank: ever steeper to the right, with holes that are dark and holes that are not matched.
    x = np.linspace(0, 0.9999, 80)
    depth = (800 - 300 * np.sqrt(1 - x**2) + rng.normal(0, 0.05, (40, 80))).astype(np.float32)
    lit = rng.random((40, 80)) > 0.1
    depth[~lit | (rng.random((40, 80)) < 0.1)] = np.nan
    sigma = np.full_like(depth, 0.05)
    found = _core.grazing_points(
        depth, sigma, np.where(lit, np.float32(1), np.float32(np.nan)), 1 / 400, 4.0, 0.5, 3.0, 2
    )
    expected = reference.grazing(depth.astype(float), 0.05, lit, 1 / 400, 4.0, 0.5, 3.0)
    assert np.array_equal(found == 1, expected)
    assert 0.05 < expected.mean() < 0.9


def test_checked_points_equal_their_numpy_twin():
    rig = small_rig()
    a, rng = rig.cameras["A"], np.random.default_rng(8)
    shape = (150, 200)
    points = plane_points(a).astype(np.float32)
    points[rng.random(shape) < 0.1] = np.nan
    miss = np.where(np.isnan(points[..., 2]), np.nan, rng.normal(0, 0.5, shape)).astype(np.float32)
    sigma = rng.uniform(0.01, 0.1, shape).astype(np.float32)
    position = (rig.projector.project(plane_points(a))[..., 0] + rng.normal(0, 0.7, shape)).astype(np.float32)
    rejected = np.where(rng.random(shape) < 0.2, 2, 0).astype(np.uint16)
    low, high = [-60.0, -50.0, -1000.0], [70.0, 80.0, 1000.0]
    limits, bits = [1.0, 0.9, 3.0], [16, 1, 64]
    projector = rig.projector.kernel_parameters
    found, depth = _core.check_points(
        points,
        sigma,
        miss,
        position,
        sigma,
        rejected,
        a.kernel_parameters,
        projector,
        0,
        [*limits, *low, *high],
        bits,
        2,
    )
    residual, spread = _core.projector_residual(projector, 0, a.center_sensor, points, sigma, position, sigma, 2)
    expected = reference.reasons_of_points(points, miss, residual, spread, rejected, low, high, limits, bits)
    assert np.array_equal(found, expected)
    assert all(((found & bit) != 0).any() for bit in bits)
    z = points @ a.T_camera_sensor[2, :3] + a.T_camera_sensor[2, 3]
    assert np.array_equal(np.isfinite(depth), found == 0)
    assert np.abs(depth - z)[found == 0].max() < 1e-3  # single precision at 1 m
    values = [np.ones((*shape, *channels), np.float32) for channels in ((), (2,), (3,))]
    for array in values:
        _core.drop_rejected(found, array, 2)
        assert np.array_equal(np.isnan(array.reshape(*shape, -1)).all(-1), found != 0)
        assert np.array_equal(np.isnan(array.reshape(*shape, -1)).any(-1), found != 0)


def test_islands_do_not_end_at_the_borders_of_strips():
    """Columns of valid pixels from top to bottom, in strips of rows that are joined afterwards; comb and spiral."""
    depth = np.full((200, 60), np.nan, np.float32)
    depth[10:190, 4::8] = 800
    depth[189, 4:30] = 800
    nothing = np.empty((0, 0), np.uint8)
    results = [_core.islands(depth, np.full_like(depth, 1e-3), nothing, 0.005, 5.0, 181, n) for n in (1, 3)]
    # The columns at 4, 12, 20, 28 hang together by the last row; the others have 180 pixels each.
    expected = np.isfinite(depth)
    expected[:, :30] = False
    assert np.array_equal(results[0] == 1, expected)
    assert np.array_equal(results[0], results[1])


def measured(volume=None):
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    found = triangulate(correspond(maps["A"], maps["B"], a, b, 2), a, b, 2)
    return found, reject_points(found, maps["A"], a, rig.projector, volume, OPTIONS, 2)


def reason(rejected, name):
    return (rejected >> REJECTIONS.index(name)) & 1 == 1


def test_points_off_the_projectors_calibration_are_mismatches():
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    found = triangulate(correspond(maps["A"], maps["B"], a, b, 2), a, b, 2)
    ok = np.isfinite(found.points_sensor[..., 2])
    moved = phase_map(maps["A"].position_px + 3.0)
    rejected = reject_points(found, moved, a, rig.projector, None, OPTIONS, 2)
    assert reason(rejected, "mismatch")[ok].all()
    assert not reason(reject_points(found, maps["A"], a, rig.projector, None, OPTIONS, 2), "mismatch").any()


def test_points_outside_the_volume_are_masked():
    found, rejected = measured(volume=Box(min=(-1000, -1000, -1000), max=(0, 1000, 1000)))
    ok = np.isfinite(found.points_sensor[..., 2])
    assert np.array_equal(reason(rejected, "masked")[ok], found.points_sensor[ok][:, 0] > 0)


def test_pixels_that_the_other_camera_does_not_see_are_unmatched():
    _, rejected = measured()
    rig = small_rig()
    pixels = rig.cameras["B"].project(plane_points(rig.cameras["A"]))
    hidden = (pixels < -1).any(-1) | (pixels[..., 0] > 200) | (pixels[..., 1] > 150)
    assert hidden.any()
    assert reason(rejected, "unmatched")[hidden].all()
