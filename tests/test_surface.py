"""The local plane fit and the gradient along the surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sheets
import synthetic
from planish.geometry import exp_se3, transform_points
from planish.registration.surface import SurfaceOptions, fit_surface
from reference import surface as reference

#: float32 points 1 m away resolve 6e-5 mm, their inverse depths as much.
POINT_TOLERANCE_MM = 2e-4
#: The kernel takes rays from the float32 points: 6e-5 mm over twice the pixel's 1.3 mm, tilted up to 60 degrees.
NORMAL_TOLERANCE_RAD = 2e-4
#: What the lens distortion bends a plane's inverse depth within a window of 7 px (quadratic term of the distortion).
PLANE_TOLERANCE_MM = 2e-3
PLANE_TOLERANCE_RAD = 3e-4


@pytest.fixture(scope="module")
def holed():
    """A bent, noisy surface with holes and a rim."""
    m = sheets.noisy(sheets.quiet("a"), 3)
    points = m.points_sensor.copy()
    points[np.random.default_rng(5).random(m.shape) < 0.1] = np.nan
    points[100:120, 50:90] = np.nan
    return replace(m, points_sensor=points)


@pytest.mark.parametrize("radius", [1, 3])
def test_the_plane_fit_is_the_one_of_its_definition(holed, radius):
    surface = fit_surface(holed, SurfaceOptions(radius_px=radius))
    rng = np.random.default_rng(0)
    # Neighbours of the pixel must be known on both sides: elsewhere the kernel takes one-sided rays.
    known = np.isfinite(surface.points_sensor[..., 0])
    rows, columns = np.nonzero(known[1:-1, 1:-1])
    for i in rng.choice(len(rows), 150, replace=False):
        u, v = columns[i] + 1, rows[i] + 1
        neighbours = holed.points_sensor[[v, v, v - 1, v + 1], [u - 1, u + 1, u, u]]
        if np.isnan(neighbours).any():
            continue
        x, n, t = reference.fit_pixel(holed.points_sensor, holed.camera, u, v, radius, 4.0)
        np.testing.assert_allclose(surface.points_sensor[v, u], x, atol=POINT_TOLERANCE_MM)
        np.testing.assert_allclose(surface.normals_sensor[v, u], n, atol=NORMAL_TOLERANCE_RAD)
        np.testing.assert_allclose(surface.tangents_sensor[v, u], t, atol=NORMAL_TOLERANCE_RAD * sheets.GSD_MM)


def test_a_plane_seen_obliquely_through_a_distorting_lens_stays_a_plane():
    T = exp_se3([0.5, 0.6, 0.2, 10, 20, 0])
    m = synthetic.measurement(T, sheets.grain(), scale=sheets.SCALE, sigma_mm=0.0)
    surface = fit_surface(m)
    heights = transform_points(T, surface.points_sensor.astype(float))[..., 2]
    assert np.isfinite(heights).mean() > 0.99
    assert np.nanmax(np.abs(heights)) < PLANE_TOLERANCE_MM
    normals = surface.normals_sensor @ T[:3, :3].T
    assert np.nanmax(np.linalg.norm(normals - [0, 0, 1], axis=2)) < PLANE_TOLERANCE_RAD


def test_noise_is_averaged_over_the_window():
    m = sheets.noisy(sheets.quiet("a", 0.0), 1)
    surface = fit_surface(m)
    heights = surface.points_sensor[20:-20, 20:-20, 2]
    raw = m.points_sensor[20:-20, 20:-20, 2]
    # An affine fit at the centre of n equal weights has the variance of the mean: 1 / 49.
    assert np.std(heights) == pytest.approx(np.std(raw) / 7, rel=0.1)


def test_normals_point_to_the_sensor_and_stand_on_the_tangents():
    surface = fit_surface(sheets.quiet("a", sheets.ROUND))
    towards = sheets.quiet("a", sheets.ROUND).camera.center_sensor - surface.points_sensor
    assert np.nanmin((surface.normals_sensor * towards).sum(2)) > 0
    for tangent in (surface.tangents_sensor[..., :3], surface.tangents_sensor[..., 3:]):
        assert np.nanmax(np.abs((tangent * surface.normals_sensor).sum(2))) < 1e-5  # float32 of lengths near 1


def test_the_fit_does_not_smooth_across_a_step_in_depth():
    m = sheets.quiet("a", 0.0)
    points = m.points_sensor.copy()
    rays = points - m.camera.center_sensor.astype(np.float32)
    # 45 mm: at this resolution up to 17 mm over the window still count as a slope (76 degrees).
    points[:, 170:] += np.float32(45 / 870) * rays[:, 170:]
    stepped = replace(m, points_sensor=points.astype(np.float32))
    surface = fit_surface(stepped)
    error = np.linalg.norm(surface.points_sensor - stepped.points_sensor, axis=2)
    assert np.isfinite(error[10:-10, 10:-10]).all()
    assert np.nanmax(error) < PLANE_TOLERANCE_MM
    np.testing.assert_allclose(surface.normals_sensor[50, [168, 169, 170, 171]], [[0, 0, 1]] * 4, atol=0.06)


def test_a_lonely_pixel_has_no_surface():
    m = sheets.quiet("a", 0.0)
    points = np.full_like(m.points_sensor, np.nan)
    points[50, 50] = m.points_sensor[50, 50]
    points[80, 80:90] = m.points_sensor[80, 80:90]
    surface = fit_surface(replace(m, points_sensor=points))
    assert np.isnan(surface.points_sensor).all()


def test_the_surface_does_not_depend_on_the_number_of_threads(holed):
    results = [fit_surface(holed, threads=threads) for threads in (1, 2, 8)]
    for name in ("points_sensor", "normals_sensor", "tangents_sensor"):
        assert len({getattr(r, name).tobytes() for r in results}) == 1


def test_the_gradient_of_a_linear_texture_is_its_slope_along_the_surface():
    m = sheets.quiet("b", 0.0)
    surface = fit_surface(m)
    slope = np.array([0.002, -0.005, 0.01])
    texture = (surface.points_sensor.astype(float) @ slope).astype(np.float32)
    gradient = sheets.texture_gradient(texture, surface)
    n = surface.normals_sensor.astype(float)
    expected = slope - (n @ slope)[..., None] * n
    assert np.isnan(gradient[[0, -1]]).all()
    # Central differences over two pixels of values near 2, which float32 resolves to 1e-7.
    assert np.nanmax(np.abs(gradient - expected)[2:-2, 2:-2]) < 2e-5


def test_the_gradient_is_the_one_of_its_definition(holed):
    surface = fit_surface(holed)
    texture = np.random.default_rng(0).standard_normal(holed.shape).astype(np.float32)
    texture[holed.rejected != 0] = np.nan
    gradient = sheets.texture_gradient(texture, surface)
    rows, columns = np.nonzero(np.isfinite(gradient[..., 0]))
    for i in range(0, len(rows), 997):
        expected = reference.gradient_of_pixel(texture, surface.tangents_sensor, columns[i], rows[i])
        np.testing.assert_allclose(gradient[rows[i], columns[i]], expected, rtol=1e-3, atol=1e-5)  # float32 products
