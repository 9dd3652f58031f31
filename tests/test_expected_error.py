"""The expected 3D error against rigs drawn from the covariance, with points intersected anew by each."""

import numpy as np
import pytest

import drawn_calibration
from planish.errors import InputError
from planish.geometry import adjoint, fit_rigid, transform_points
from planish.rig import Rig
from planish.sensing.calibrate.judge.expected_error import (
    device_pairs,
    expected_error,
    expected_error_on_plane,
    map_rms,
    pixel_grid,
    points_at_depth,
)

DEPTH_MM, COLUMNS, DRAWS = 870.0, 7, 1200
#: 1200 draws know a standard deviation to 2 % (1 / sqrt(2 * 1200)): 4 times that at the worst place, 2 times overall.
WORST, OVERALL = 0.09, 0.04


@pytest.fixture(scope="module")
def rig():
    return drawn_calibration.calibration().rig


def intersect(rig, own, other, pixel, seen_px, along):
    """Points on the rays of `pixel` in `own` that are nearest to `seen_px` in `other`: Newton on the depth.

    Near means along `along` in the image, or without it in the undistorted image.
    """
    devices = rig.devices
    origin, ray = devices[own].center_sensor, devices[own].rays_sensor(pixel)
    T = devices[other].T_camera_sensor
    target = devices[other].rays_sensor(seen_px) @ T[:3, :3].T

    def miss(depth):
        x = origin + ray * depth[:, None]
        if along is not None:
            return (devices[other].project(x) - seen_px) @ along
        y = x @ T[:3, :3].T + T[:3, 3]
        n = y[:, :2] / y[:, 2:]
        step = (ray @ T[:3, :3].T)[:, :2] - n * (ray @ T[:3, :3].T)[:, 2:]
        return ((n - target[:, :2]) * step).sum(1) / np.linalg.norm(step, axis=1)

    depth = np.full(len(pixel), DEPTH_MM)
    for _ in range(6):
        slope = (miss(depth + 1e-2) - miss(depth - 1e-2)) / 2e-2
        depth = depth - miss(depth) / slope
    return origin + ray * depth[:, None]


def sampled(rig, own, other, expected, along):
    """Error, form error and factor of the points of rigs drawn from the covariance."""
    seen = np.isfinite(expected.sensor_mm)
    x, pixel = expected.points_sensor[seen], expected.pixel_px[seen]
    seen_px = rig.devices[other].project(x)
    rng, modes = np.random.default_rng(5), rig.modes()
    errors, forms, factors = [], [], []
    for _ in range(DRAWS):
        drawn = rig.changed(rng.standard_normal(len(modes)) @ modes)
        points = intersect(drawn, own, other, pixel, seen_px, along)
        form = transform_points(fit_rigid(x, points), points) - x
        arm = x - x.mean(0)
        errors.append(points - x)
        forms.append(form)
        factors.append((form * arm).sum() / (arm**2).sum())
    return [np.sqrt((np.array(e) ** 2).sum(-1).mean(0)) for e in (errors, forms)], np.std(factors), seen


@pytest.mark.parametrize(("other", "along"), [("B", None), ("projector", None), ("projector", (1.0, 0.0))])
def test_the_expected_error_is_that_of_drawn_rigs(rig, other, along):
    expected = expected_error_on_plane(rig, "A", other, DEPTH_MM, along, COLUMNS)
    along = None if along is None else np.array(along)
    (error, form), factor, seen = sampled(rig, "A", other, expected, along)
    for predicted, found in ((expected.sensor_mm[seen], error), (expected.form_mm[seen], form)):
        assert np.abs(found / predicted - 1).max() < WORST
        assert abs(map_rms(found) / map_rms(predicted) - 1) < OVERALL
    assert abs(factor / expected.scale_sigma - 1) < OVERALL * 2


def test_an_uncertain_pitch_alone_is_a_factor_on_all_lengths(rig):
    names = [f"B.translation_{axis}" for axis in "xyz"]
    t = rig.cameras["B"].T_camera_sensor[:3, 3]
    scaled = Rig(rig.cameras, None, (1e-4) ** 2 * np.outer(t, t), tuple(names))
    expected = expected_error_on_plane(scaled, "A", "B", DEPTH_MM)
    assert np.isclose(expected.scale_sigma, 1e-4, rtol=1e-6)
    np.testing.assert_allclose(expected.scale_mm, expected.form_mm, rtol=1e-6)
    np.testing.assert_allclose(expected.sensor_mm, 1e-4 * np.linalg.norm(expected.points_sensor, axis=-1), rtol=1e-6)


def test_a_rig_that_turned_as_a_whole_has_no_error_of_form(rig):
    """All devices moved alike: the covariance moved to another frame and back again would be this."""
    names = [f"{d}.{p}" for d in ("A", "B") for p in ("rotation_x", "rotation_y", "rotation_z")]
    names += [f"{d}.{p}" for d in ("A", "B") for p in ("translation_x", "translation_y", "translation_z")]
    J = np.concatenate([adjoint(rig.cameras[d].T_camera_sensor)[rows] for rows in (slice(0, 3), slice(3, 6))
                        for d in ("A", "B")])  # fmt: skip
    xi = np.diag([1e-4, 2e-4, 1e-4, 0.1, 0.05, 0.02]) ** 2
    expected = expected_error_on_plane(Rig(rig.cameras, None, J @ xi @ J.T, tuple(names)), "A", "B", DEPTH_MM)
    assert map_rms(expected.sensor_mm) > 0.1
    assert map_rms(expected.form_mm) < 1e-6


def test_what_the_other_device_does_not_see_is_left_out(rig):
    expected = expected_error_on_plane(rig, "A", "B", 500.0)
    assert np.isnan(expected.sensor_mm).any()
    assert np.isfinite(expected.sensor_mm).any()
    pixel = rig.cameras["B"].project(expected.points_sensor)
    outside = np.isnan(pixel).any(-1)
    assert np.array_equal(outside, np.isnan(expected.sensor_mm))


def test_any_depth_map_has_its_expected_error(rig):
    pixels = pixel_grid(rig.cameras["A"], 8)
    depth = DEPTH_MM + 20 * np.sin(pixels[..., 0] / 200)
    depth[0, 0] = np.nan
    points = points_at_depth(rig.cameras["A"], pixels, depth)
    expected = expected_error(rig, "A", "B", pixels, points)
    assert np.isnan(expected.form_mm[0, 0])
    np.testing.assert_allclose(rig.cameras["A"].project(points)[1:], pixels[1:], atol=1e-6)
    assert 0.5 < map_rms(expected.form_mm) / map_rms(expected_error_on_plane(rig, "A", "B", DEPTH_MM).form_mm) < 2


def test_a_rig_without_covariance_has_no_expected_error(rig):
    bare = Rig(rig.cameras, rig.projector)
    assert device_pairs(bare) == (("A", "B"), ("A", "projector"))
    with pytest.raises(InputError, match="covariance"):
        expected_error_on_plane(bare, "A", "B", DEPTH_MM)
