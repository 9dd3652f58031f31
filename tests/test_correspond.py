"""Correspondence and triangulation against exact geometry and their NumPy twins."""

import numpy as np
import pytest

from planish import _core
from planish.geometry import compose, exp_so3, invert
from planish.rig import Camera
from planish.sensing.decode import PhaseMap
from planish.sensing.points.correspond import Correspondences, correspond, undistortion_shifts
from planish.sensing.points.triangulate import triangulate
from reference import sensing as reference
from sequences import plane_points, small_rig

#: A plane's position is no linear function of the pixel: what interpolation over one pixel leaves here [px].
INTERPOLATION_PX = 2e-3
#: 16 px between the nodes of the table, against the exact inverse.
TABLE_PX = 1e-4
SIGMA = 0.01
#: Single precision of the curve's row and of the place on it, at 200 px.
ROUNDING_PX = 1e-4


def phase_map(positions, sigma=SIGMA):
    positions = positions.astype(np.float32)
    sigmas, rejected = np.full(positions.shape, sigma, np.float32), np.zeros(positions.shape, np.uint16)
    return PhaseMap("u", positions, sigmas, rejected)


def plane_maps(rig, tilt=(0.1, -0.05)):
    return {
        name: phase_map(rig.projector.project(plane_points(cam, tilt))[..., 0]) for name, cam in rig.cameras.items()
    }


def visible(points, camera):
    pixels = camera.project(points)
    inside = (pixels > 2).all(-1) & (pixels[..., 0] < camera.size_px[0] - 3) & (pixels[..., 1] < camera.size_px[1] - 3)
    return pixels, inside


@pytest.mark.parametrize("own", ["A", "B"])
def test_correspondences_of_a_plane_are_exact_with_distortion(own):
    rig, other = small_rig(), "B" if own == "A" else "A"
    maps = plane_maps(rig)
    truth, inside = visible(plane_points(rig.cameras[own]), rig.cameras[other])
    found = correspond(maps[own], maps[other], rig.cameras[own], rig.cameras[other], 2).pixel_px
    assert np.isfinite(found[inside]).all()
    assert np.abs(found - truth)[inside].max() < INTERPOLATION_PX


def test_points_lie_on_their_own_rays_and_on_the_plane():
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    pairs = correspond(maps["A"], maps["B"], a, b, 2)
    found = triangulate(pairs, a, b, 2)
    ok = np.isfinite(pairs.pixel_px[..., 0])
    points = found.points_sensor.astype(float)
    # 1 px of disparity is about 3.4 mm here.
    assert np.abs(points - plane_points(a))[ok].max() < 5 * INTERPOLATION_PX
    u, v = np.meshgrid(np.arange(200), np.arange(150))
    off = np.abs(a.project(points[ok]) - np.stack([u, v], -1)[ok]).max()
    assert off < TABLE_PX + 5e-5  # single precision of the points
    assert np.abs(found.miss_px[ok]).max() < 5e-3


def test_the_search_finds_what_a_complete_search_finds():
    """Against brute force over the whole curve, on a map with gaps, jumps and a fold; noise-free and noisy."""
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    rng = np.random.default_rng(5)
    other = maps["B"].position_px + rng.normal(0, 0.3, (150, 200)).astype(np.float32)
    other[40:90, 60:110] += 37
    other[100:130, 120:122] = np.nan
    own = maps["A"].position_px
    found = correspond(phase_map(own), phase_map(other, 0.3), a, b, 2).pixel_px
    single = missing = 0
    for v in range(5, 150, 12):
        for u in range(3, 200, 5):
            expected = reference.epipolar_crossings(other.astype(float), b, a, u, v, float(own[v, u]))
            if len(expected) == 0:
                assert np.isnan(found[v, u]).all()
                missing += 1
            elif len(expected) == 1:
                # The refinement by the spline moves within the noise: less than a pixel by definition.
                assert np.abs(found[v, u] - expected[0]).max() < 1.1
                single += 1
            elif np.isfinite(found[v, u, 0]):
                assert np.abs(found[v, u] - expected).max(1).min() < 1.1
    assert single > 100
    assert missing > 20


def test_cameras_above_each_other_are_matched_too():
    """Baseline and fringes turned by 90 degrees: the search runs along columns."""
    rig = small_rig()
    turn = compose(exp_so3([0, 0, np.pi / 2]), [0, 0, 0])
    size = (150, 200)

    def turned(camera: Camera) -> Camera:
        K = camera.K.copy()
        K[:2, 2] = [149 - camera.K[1, 2], camera.K[0, 2]]
        K[0, 0], K[1, 1] = camera.K[1, 1], camera.K[0, 0]
        return Camera.make(K, [*camera.distortion[:2], 0, 0], size, turn @ camera.T_camera_sensor)

    a, b = turned(rig.cameras["A"]), turned(rig.cameras["B"])
    maps = [phase_map(rig.projector.project(plane_points(cam))[..., 0]) for cam in (a, b)]
    found = correspond(*maps, a, b, 2)
    truth, inside = visible(plane_points(a), b)
    assert np.abs(found.pixel_px - truth)[inside].max() < INTERPOLATION_PX
    points = triangulate(found, a, b, 2).points_sensor
    assert np.abs(points - plane_points(a))[inside].max() < 5 * INTERPOLATION_PX


def test_sigma_is_the_scatter_along_the_ray():
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    rng = np.random.default_rng(2)
    noisy = {
        name: phase_map(m.position_px + rng.normal(0, 0.05, m.position_px.shape), 0.05) for name, m in maps.items()
    }
    pairs = correspond(noisy["A"], noisy["B"], a, b, 2)
    found = triangulate(pairs, a, b, 2)
    center = a.center_sensor
    error = np.linalg.norm(found.points_sensor - center, axis=-1) - np.linalg.norm(plane_points(a) - center, axis=-1)
    _, inside = visible(plane_points(a), b)
    normalised = (error / found.sigma_mm)[inside]
    # 14,000 points: the standard error of a standard deviation is 0.6 %; sigma rests on a noisy local slope.
    assert np.nanstd(normalised) == pytest.approx(1.0, abs=0.03)
    assert abs(np.nanmedian(normalised)) < 0.03


def test_triangulation_equals_its_numpy_twin():
    rig = small_rig()
    a, b = rig.cameras["A"], rig.cameras["B"]
    truth, inside = visible(plane_points(a), b)
    pixel = np.where(inside[..., None], truth, np.nan).astype(np.float32)
    found = triangulate(Correspondences(pixel, np.where(inside, 0.1, np.nan).astype(np.float32)), a, b, 2)
    for v, u in np.argwhere(inside)[::997]:
        expected = reference.triangulate(a, b, u, v, pixel[v, u])
        # The twin minimises the distance of the rays, the kernel the angle: they differ by the square of the miss.
        assert np.abs(found.points_sensor[v, u] - expected).max() < 2e-3


def test_the_table_of_shifts_equals_the_exact_inverse_of_the_distortion():
    camera = small_rig().cameras["A"]
    shifts = undistortion_shifts(camera, 2)
    for u, v in [(0, 0), (199, 149), (7, 133), (101, 64), (180, 20)]:
        assert np.abs(np.array([u, v]) + shifts[v, u] - reference.ideal_pixel(camera, [u, v])).max() < TABLE_PX


def test_the_projector_residual_is_the_difference_of_positions():
    rig = small_rig()
    a = rig.cameras["A"]
    points = plane_points(a).astype(np.float32)
    position = rig.projector.project(plane_points(a))[..., 0].astype(np.float32) + np.float32(0.25)
    sigma = np.full(position.shape, 0.1, np.float32)
    residual, spread = _core.projector_residual(
        rig.projector.kernel_parameters, 0, a.center_sensor, points, sigma, position, sigma, 2
    )
    assert np.abs(residual + 0.25).max() < 1e-3
    beyond = rig.projector.project(points + 0.1 * _unit(points - a.center_sensor))[..., 0]
    expected = np.hypot(beyond - rig.projector.project(points)[..., 0], 0.1)
    assert np.abs(spread / expected - 1).max() < 1e-2


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_the_result_does_not_depend_on_the_number_of_threads():
    rig = small_rig()
    maps = plane_maps(rig)
    rng = np.random.default_rng(7)
    own = phase_map(maps["A"].position_px + rng.normal(0, 0.2, (150, 200)), 0.2)
    results = [correspond(own, maps["B"], rig.cameras["A"], rig.cameras["B"], n) for n in (1, 2, 8)]
    for other in results[1:]:
        assert results[0].pixel_px.tobytes() == other.pixel_px.tobytes()
        assert results[0].sigma_px.tobytes() == other.sigma_px.tobytes()


def test_two_cameras_at_one_place_are_refused():
    rig = small_rig()
    maps, a = plane_maps(rig), rig.cameras["A"]
    with pytest.raises(ValueError, match="same place"):
        correspond(maps["A"], maps["A"], a, a, 1)


@pytest.mark.parametrize("distance_mm", [150, -150])
def test_a_camera_in_front_of_or_behind_the_other_one_is_refused(distance_mm):
    rig = small_rig()
    maps, a = plane_maps(rig), rig.cameras["A"]
    ahead = Camera.make(a.K, a.distortion, a.size_px, compose(np.eye(3), [4, -3, distance_mm]) @ a.T_camera_sensor)
    with pytest.raises(ValueError, match="field of view"):
        correspond(maps["A"], maps["A"], a, ahead, 1)


def test_the_result_does_not_depend_on_where_the_rows_above_start():
    """Rows cut off above: other starts, blocks of other rows; the same places but for rounding."""
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    rng = np.random.default_rng(3)
    own = maps["A"].position_px + rng.normal(0, 0.05, (150, 200)).astype(np.float32)
    other = phase_map(maps["B"].position_px + rng.normal(0, 0.05, (150, 200)), 0.05)
    whole = correspond(phase_map(own, 0.05), other, a, b, 1).pixel_px
    own[:37] = np.nan
    cut = correspond(phase_map(own, 0.05), other, a, b, 1).pixel_px
    assert np.array_equal(np.isfinite(whole[37:]), np.isfinite(cut[37:]))
    assert np.nanmax(np.abs(whole - cut)[37:]) < ROUNDING_PX


def test_gaps_and_edges_of_the_image_take_the_crossing_alone():
    """Where the spline's 4 x 4 pixels are not all there: bilinear, with its own weights in sigma."""
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    truth, inside = visible(plane_points(a), b)
    other = maps["B"].position_px.copy()
    other[::4] = np.nan
    found = correspond(maps["A"], phase_map(other), a, b, 2)
    rows = truth[..., 1] % 4
    # The curves rise by up to 0.15 px per column, and both columns of a crossing count.
    bridged = inside & (rows > 1.2) & (rows < 2.8)
    assert np.isfinite(found.pixel_px[bridged]).all()
    assert np.abs(found.pixel_px - truth)[bridged].max() < INTERPOLATION_PX
    v, u = np.round(truth[bridged]).astype(int).T[::-1]
    slope = np.gradient(maps["B"].position_px, axis=1)[v, u]
    share = (found.sigma_px[bridged] * slope / SIGMA) ** 2 - 1
    # Weights of two columns and two rows: between 1/4 in the middle and 1 at a pixel.
    assert share.min() > 0.25 - 0.1
    assert 0.9 < share.max() < 1.1
    assert not np.isfinite(found.pixel_px[inside & ((rows < 0.8) | (rows > 3.2))]).any()


def test_a_rig_turned_as_a_whole_gives_turned_points():
    rig = small_rig()
    maps, (a, b) = plane_maps(rig), (rig.cameras["A"], rig.cameras["B"])
    T_new_old = compose(exp_so3([0.3, -0.2, 1.0]), [50, -20, 300])
    moved = [Camera.make(c.K, c.distortion, c.size_px, c.T_camera_sensor @ invert(T_new_old)) for c in (a, b)]
    pairs = correspond(maps["A"], maps["B"], a, b, 2)
    before, after = triangulate(pairs, a, b, 2), triangulate(pairs, *moved, 2)
    expected = before.points_sensor @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    ok = np.isfinite(expected[..., 0])
    assert np.abs(after.points_sensor - expected)[ok].max() < 1e-3
    assert np.abs(after.sigma_mm - before.sigma_mm)[ok].max() < 1e-5
