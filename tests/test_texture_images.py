"""Charts and texture images: as many as the surface needs, metric, not mirrored."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import sheets
import synthetic
from planish import _core
from planish.geometry import exp_se3, invert, is_rigid, transform_points
from planish.measurement import View
from planish.registration.surface import fit_surface
from planish.registration.texture.charts import ChartOptions, plan_charts
from planish.registration.texture.photometric import PhotometricOptions, local_contrast
from planish.registration.texture.resample import texture_images
from planish.rig import Rig
from reference import chart as reference

#: float32 barycentric weights of triangles about a pixel wide.
RASTER_TOLERANCE = 2e-4
#: A plane fit over +-3 px of 1.3 mm, more where it is foreshortened, cuts the bent sheet (curvature 1/800 and 1/1600
#: per mm) by half the curvature times the mean square distance: 0.006 mm in the middle, three times that at the rim.
SURFACE_TOLERANCE_MM = 0.02
#: A linear interpolation between pixels of a projection that is nearly linear.
PIXEL_TOLERANCE = 5e-3


def images(m):
    return texture_images(m, fit_surface(m), local_contrast(m), sheets.PITCH_MM)


@pytest.fixture(scope="module")
def bent():
    return images(sheets.quiet("a"))[0]


@pytest.fixture(scope="module")
def pipe():
    m = sheets.quiet("a", sheets.ROUND)
    return m, fit_surface(m)


def test_a_tiny_chart_is_rastered_as_defined():
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:7, :9]
    points = np.stack([columns * 1.1, rows * 0.9, 0.3 * columns], -1) + 0.1 * rng.standard_normal((7, 9, 3))
    points[2, 3] = np.nan
    points[5, 6:] += [0, 0, 2.0]
    normals = np.tile(np.float32([0, 0, -1]), (7, 9, 1))
    normals[0, :3] = [1, 0, 0]
    T = exp_se3([0.1, -0.05, 0.2, 0.5, 0.4, 1.0])
    args = (normals, T, 0.35, 0.8, 2.5, 24, 30)
    source, z = _core.rasterise_chart(points.astype(np.float32), *args, 2)
    source_twin, z_twin = reference.rasterise(points.astype(np.float32), *args)
    assert 100 < np.isfinite(z).sum() < z.size
    # The kernel is generous by 1e-4 of a triangle: pixels exactly on a rim may differ.
    assert (np.isfinite(z) != np.isfinite(z_twin)).sum() <= 2
    np.testing.assert_allclose((z - z_twin)[np.isfinite(z - z_twin)], 0, atol=RASTER_TOLERANCE)
    both = np.isfinite(source[..., 0] - source_twin[..., 0])
    np.testing.assert_allclose(source[both], source_twin[both], atol=RASTER_TOLERANCE)


def test_of_two_layers_the_one_nearer_to_the_sensor_is_seen():
    rows, columns = np.mgrid[:4, :4].astype(np.float32)
    near, far = np.stack([columns, rows, 0 * rows + 1], -1), np.stack([columns, rows, 0 * rows + 5], -1)
    gap = np.full((1, 4, 3), np.nan, np.float32)
    normals = np.tile(np.float32([0, 0, -1]), (9, 4, 1))
    for layers in ((near, gap, far), (far, gap, near)):
        _, z = _core.rasterise_chart(np.concatenate(layers), normals, np.eye(4), 1.0, 0.8, 3.0, 4, 4, 2)
        np.testing.assert_array_equal(z, 1)


def seen_by_two(m, seed):
    """A measurement of an even grey, read between the pixels of the second camera, with noise of both."""
    rng, deviation = np.random.default_rng(seed), np.sqrt((sheets.NOISE.offset + sheets.NOISE.slope * 100) / 12)
    images = {name: (100 + deviation * rng.standard_normal(m.shape)).astype(np.float32) for name in "AB"}
    views = {name: View(None, image, None, 12, sheets.NOISE, 255.0) for name, image in images.items()}
    rows, columns = np.indices(m.shape).astype(np.float32)
    place = np.stack([1.003 * columns + 0.2, 0.998 * rows + 0.4], -1)
    return replace(
        m, rig=Rig(dict.fromkeys("AB", m.camera)), views=views, correspondence_px=place, texture_views=("A", "B")
    )


@pytest.mark.parametrize("pitch_gsd", [1.0, 1.5, 2.0])
def test_the_stated_sigma_of_a_texture_image_is_the_scatter_of_its_values(pitch_gsd):
    plate = sheets.quiet("a", 0.0)
    surface = fit_surface(plate)
    pitch = pitch_gsd * plate.sample_distance_mm
    seen = [seen_by_two(plate, seed) for seed in range(10)]
    # A low-pass as wide against the pixels as it is at half resolution: the noise it takes with it is no part of sigma.
    options = PhotometricOptions(shading_mm=4 * plate.sample_distance_mm)
    drawn = [texture_images(m, surface, local_contrast(m, options, surface), pitch)[0] for m in seen]
    inner = cv2.erode(drawn[0].mask.astype(np.uint8), np.ones((15, 15))) > 0
    scatter = np.var([i.value[inner] for i in drawn], axis=0, ddof=1).mean()
    stated = np.mean([i.sigma[inner] ** 2 for i in drawn])
    assert 0.93 < np.sqrt(scatter / stated) < 1.05


def test_a_plate_needs_one_chart():
    for side in "ab":
        m = sheets.quiet(side, 0.0)
        assert len(plan_charts(m, fit_surface(m))) == 1


def test_a_pipe_needs_several_charts_that_overlap_and_cover_it(pipe):
    m, surface = pipe
    options = ChartOptions()
    charts = plan_charts(m, surface, options)
    assert 2 <= len(charts) <= options.max_charts
    normals = surface.normals_sensor[np.isfinite(surface.normals_sensor[..., 0])]
    angles = np.rad2deg([np.arccos(np.clip(normals @ -T[2, :3], -1, 1)) for T in charts])
    assert (angles.min(0) > options.core_deg).mean() <= options.uncovered
    assert ((angles < options.reach_deg).sum(0) >= 2).mean() > 0.1


def test_a_measurement_without_surface_has_no_chart(pipe):
    m, surface = pipe
    nothing = type(surface)(*(np.full_like(getattr(surface, n), np.nan) for n in surface.__dataclass_fields__))
    assert plan_charts(m, nothing) == ()


def test_charts_are_right_handed_with_z_into_the_surface(pipe):
    m, surface = pipe
    for T in plan_charts(m, surface):
        assert is_rigid(T)
        assert T[2, :3] @ (surface.points_sensor[130, 170] - m.camera.center_sensor) > 0


def test_pictures_are_not_mirrored_and_upright_as_the_camera_sees_them(bent):
    assert np.nanmedian(np.diff(bent.source_px[..., 0], axis=1)) > 0
    assert np.nanmedian(np.diff(bent.source_px[..., 1], axis=0)) > 0


def test_texture_pixels_lie_on_the_surface_at_their_metric_place(bent):
    rows, columns = np.nonzero(bent.mask)
    chart = np.column_stack([columns * bent.pitch_mm, rows * bent.pitch_mm, bent.height_mm[rows, columns]])
    points = transform_points(invert(bent.T_chart_sensor), chart)
    height = synthetic.height(points[:, 0], points[:, 1], sheets.BENT)
    assert np.abs(points[:, 2] - height).max() < SURFACE_TOLERANCE_MM
    camera = sheets.quiet("a").camera
    np.testing.assert_allclose(camera.project(points), bent.source_px[rows, columns], atol=PIXEL_TOLERANCE)
    # Nothing of the surface is missing but a rim, nothing beyond it is invented.
    assert bent.mask.mean() > 0.8
    assert (bent.normal_chart[bent.mask][:, 2] < 0).all()


def test_marks_on_the_part_keep_their_distance():
    """Two dots 180.0 mm apart on a plate, seen obliquely by a turned sensor."""
    texture = np.ones((6400, 6400), np.float32)
    marks = np.array([[-80.0, -30.0], [80.0, 52.4621]])
    rows, columns = np.indices((80, 80))
    for x, y in marks:
        column, row = ((c + synthetic.RASTER_MM) / synthetic.RASTER_PITCH_MM for c in (x, y))
        u0, v0 = round(column) - 40, round(row) - 40
        dot = np.exp(-((columns + u0 - column) ** 2 + (rows + v0 - row) ** 2) / (2 * 14.0**2))
        texture[v0 : v0 + 80, u0 : u0 + 80] -= 0.3 * dot
    m = synthetic.measurement(
        exp_se3([0.3, -0.2, 0.6, 5, 8, 0]), texture, scale=sheets.SCALE, noise=sheets.QUIET, sigma_mm=0.0
    )
    image = images(m)[0]
    found = []
    value = np.where(image.mask, -image.value, 0)
    for _ in marks:
        v, u = np.unravel_index(np.argmax(value), value.shape)
        window = value[v - 2 : v + 3, u - 2 : u + 3].clip(0)
        y, x = np.indices(window.shape) - 2
        found.append([u + (window * x).sum() / window.sum(), v + (window * y).sum() / window.sum()])
        cv2.circle(value, (int(u), int(v)), 10, 0.0, -1)
    distance = np.linalg.norm(np.subtract(*found)) * image.pitch_mm
    # A centroid over 5 x 5 pixels of 1.9 mm of a dot of 4 mm: a twentieth of a pixel each.
    assert distance == pytest.approx(np.linalg.norm(marks[0] - marks[1]), abs=0.15)


def test_the_picture_shows_the_texture_that_is_on_the_part(bent):
    """It correlates with the raster at the place its own metric coordinates name, and less one pixel beside it."""
    rows, columns = np.nonzero(bent.mask)
    chart = np.column_stack([columns * bent.pitch_mm, rows * bent.pitch_mm, bent.height_mm[rows, columns]])
    points = transform_points(invert(bent.T_chart_sensor), chart)
    truth = cv2.GaussianBlur(sheets.grain(), (0, 0), 6)

    def correlation(dx, dy):
        at = (points[:, :2] + [dx, dy] + synthetic.RASTER_MM) / synthetic.RASTER_PITCH_MM
        column, row = np.rint(at).astype(int).T
        return np.corrcoef(truth[row, column], bent.value[rows, columns])[0, 1]

    here = correlation(0, 0)
    # The shading's low-pass takes the coarse part of the grain away.
    assert here > 0.7
    assert all(correlation(dx, dy) < here for dx, dy in ((0.7, 0), (-0.7, 0), (0, 0.7), (0, -0.7)))
