"""What averages over pixels do to heights: derivatives, where they vanish, and the heights of a pipe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sheets
from planish.geometry import transform_points
from planish.pipeline import measure
from planish.registration.refine.blur import _means, _phase_shifts, _quadratic_fits, _spread, height_by_blur
from planish.registration.surface import fit_surface
from planish.sensing.capture.manifest import Capture
from planish.simulation.scenes import make_scene
from planish.simulation.texture import BLANK
from planish.simulation.writing import write_scene

#: Value, d/du, d/dv, d2/du2, d2/dudv, d2/dv2 of quadratic fields about (0, 0).
U_B, V_B = (3.0, 0.8, 0.05, 0.004, 0.001, -0.002), (5.0, -0.02, 1.1, 0.001, 0.002, 0.003)
#: Phase and light in b's pixels about (3, 5).
PHASE_B, LIGHT_B = (1.0, 0.3, 0.05, 0.006, -0.002, 0.004), (0.0, -0.03, 0.02, 0.0, 0.0, 0.0)
#: Displacements that count [mm], and the share of them that may be left: the fits reach over several pixels.
LIMB_MM, LEFT_SHARE, SPLINE_SHARE = 0.001, 0.25, 0.4
#: Differences over this many pixels give second derivatives to 1e-7 [px].
STEP = 1e-3


def quadratic(c, u, v):
    return c[0] + c[1] * u + c[2] * v + c[3] * u * u / 2 + c[4] * u * v + c[5] * v * v / 2


def derivatives(f):
    """The six numbers of a fit, by differences about (0, 0)."""
    h = STEP
    first = (f(h, 0) - f(-h, 0)) / (2 * h), (f(0, h) - f(0, -h)) / (2 * h)
    second = (f(h, 0) - 2 * f(0, 0) + f(-h, 0)) / h**2, (f(0, h) - 2 * f(0, 0) + f(0, -h)) / h**2
    mixed = (f(h, h) - f(h, -h) - f(-h, h) + f(-h, -h)) / (4 * h * h)
    return np.array([f(0, 0), *first, second[0], mixed, second[1]])[:, None]


def one_place(c):
    return np.array(c)[:, None]


def shift(c, light):
    return c[1] * light[1] + c[2] * light[2] + (c[3] + c[5]) / 2


def test_the_shift_is_the_difference_of_both_cameras_shifts_each_in_its_own_pixels():
    def seen_by_a(c):
        return derivatives(lambda u, v: quadratic(c, quadratic(U_B, u, v) - 3, quadratic(V_B, u, v) - 5))

    phase, light = seen_by_a(PHASE_B), seen_by_a(LIGHT_B)
    found, laplacian, slope = _phase_shifts(one_place(U_B), one_place(V_B), phase, light)
    assert found[0] == pytest.approx(shift(phase[:, 0], light[:, 0]) - shift(PHASE_B, LIGHT_B), abs=1e-7)
    assert laplacian[0] == pytest.approx(PHASE_B[3] + PHASE_B[5], abs=1e-7)
    assert abs(found[0]) > 1e-3
    np.testing.assert_allclose(np.ravel(slope), PHASE_B[1:3], atol=1e-7)


def test_cameras_that_see_alike_are_shifted_alike():
    u, v = one_place((7.0, 1, 0, 0, 0, 0)), one_place((9.0, 0, 1, 0, 0, 0))
    assert _phase_shifts(u, v, one_place(PHASE_B), one_place(LIGHT_B))[0] == pytest.approx(0, abs=1e-12)


def test_the_fit_of_a_quadratic_field_is_exact_at_a_rim_too():
    v, u = np.indices((60, 80)).astype(float)
    known = u > 20
    # Means over two pixels: derivatives are per pixel all the same.
    field = quadratic(U_B, 2 * (u - 40), 2 * (v - 30)).astype(np.float32)
    (found,), enough = _quadratic_fits([field], known, np.array([30, 30]), np.array([40, 22]))
    assert enough.all()
    # float32 sums over a window of 13 px.
    np.testing.assert_allclose(found[1:, 0], U_B[1:], atol=2e-5)
    np.testing.assert_allclose(found[3:, 1], U_B[3:], atol=2e-4)


def test_a_square_of_pixels_with_an_unknown_one_is_unknown():
    field = np.arange(20, dtype=np.float32).reshape(4, 5)
    field[1, 1] = np.nan
    np.testing.assert_array_equal(_means(field), [[np.nan, 5.0], [13.0, 15.0]])


def test_values_spread_from_the_nearest_known_one():
    sparse = np.full((6, 8), np.nan, np.float32)
    sparse[2, 3] = 4.0
    assert (_spread(sparse, (24, 32)) == 4.0).all()


def test_one_camera_alone_has_no_shift():
    m = sheets.quiet("a")
    assert not np.any(height_by_blur(m, fit_surface(m)))


@pytest.fixture(scope="module")
def pipe(tmp_path_factory):
    """A pipe as seen without noise: heights [mm] over its surface, what displaces them, and who made the points."""
    scene = make_scene("pipe", 3, 1, scale=0.5)
    sensor = replace(scene.sensor, noise_factor=0.0, prnu=0.0, dust=0, bits=16, samples_per_px=3)
    scene = replace(scene, sensor=sensor, texture=BLANK, light=replace(scene.light, specular=0.0))
    (folder,) = write_scene(scene, tmp_path_factory.mktemp("pipe"), true_points=False)
    m = measure(Capture.load(folder), None, 2)
    x, _, z = np.moveaxis(transform_points(scene.T_object_sensor[0], m.points_sensor.astype(float)), -1, 0)
    radius = scene.surface.radius
    of_both = m.valid & np.isfinite(m.correspondence_px[..., 0])
    blur_px2 = sensor.psf_px**2 + 1 / 12
    by_blur, by_spline = height_by_blur(m, fit_surface(m))
    return np.hypot(x, z + radius) - radius, blur_px2 * by_blur, by_spline, of_both, m.valid & ~of_both


def test_blur_and_spline_explain_the_heights_of_a_pipe(pipe):
    heights, by_blur, by_spline, both, _ = pipe
    # Where they displace by micrometres: towards the limb of either camera.
    limb = both & (np.abs(by_blur) > LIMB_MM)
    left = heights - by_blur - by_spline
    assert limb.sum() > 1000
    assert np.abs(np.median(left[limb])) < LEFT_SHARE * np.median(np.abs(heights[limb]))
    # By how much of what the spline is said to do the heights differ without it (least squares).
    oblique = both & (by_spline < -LIMB_MM)
    assert oblique.sum() > 1000
    without, spline = (heights - by_blur)[oblique], by_spline[oblique]
    assert without @ spline / (spline @ spline) == pytest.approx(1, abs=SPLINE_SHARE)


def test_points_of_camera_and_projector_move_by_all_that_the_phase_does(pipe):
    heights, by_blur, by_spline, _, alone = pipe
    assert not by_spline[alone].any()
    limb = alone & (np.abs(by_blur) > LIMB_MM)
    assert limb.sum() > 500
    assert abs(np.median((heights - by_blur)[limb])) < LEFT_SHARE * np.median(np.abs(heights[limb]))
