"""Texture images: metric, not mirrored, each pixel at its place on the part."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import sheets
import synthetic
from planish import _core
from planish.geometry import exp_se3
from planish.measurement import View
from planish.registration.surface import fit_surface
from planish.registration.texture.charts import plan_charts
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
    surface = fit_surface(m)
    return texture_images(m, surface, local_contrast(m), sheets.PITCH_MM, plan_charts(m, surface))


@pytest.fixture(scope="module")
def bent():
    return images(sheets.quiet("a"))[0]


def tiny_chart():
    """A bent patch of 7 x 9 pixels with nodes every two pixels, one missing."""
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:7, :9]
    points = np.stack([columns * 1.1, rows * 0.9, 0.3 * columns], -1) + 0.1 * rng.standard_normal((7, 9, 3))
    points[2, 3] = np.nan
    points[5, 6:] += [0, 0, 2.0]
    normals = np.tile([-0.26, 0, -0.97], (7, 9, 1)) + 0.05 * rng.standard_normal((7, 9, 3))
    nodes = np.zeros((3, 4, 13))
    for i in np.ndindex(3, 4):
        frame = exp_se3([0.0, 0.29, 0.0, 0.5, 0.4, 0.3] + 0.01 * rng.standard_normal(6))
        nodes[i] = [1, *frame[:3, :3].ravel(), *frame[:3, 3]]
    nodes[1, 2] = 0
    return points.astype(np.float32), normals.astype(np.float32), nodes.astype(np.float32)


def test_pixels_find_their_place_on_the_unrolled_surface_as_defined():
    points, _, nodes = tiny_chart()
    places, known, extent = _core.chart_coordinates(points, nodes, 2, 1.0, 1)
    np.testing.assert_array_equal(known, np.isfinite(points[..., 2]))
    twin = reference.coordinates(points, nodes, 2, 1.0)
    assert 30 < np.isfinite(twin[..., 0]).sum() < twin[..., 0].size - 1
    np.testing.assert_allclose(places, twin, atol=RASTER_TOLERANCE)
    np.testing.assert_allclose(extent, [*np.nanmin(twin, (0, 1)), *np.nanmax(twin, (0, 1))], atol=RASTER_TOLERANCE)


def test_a_tiny_chart_is_rastered_as_defined():
    points, normals, nodes = tiny_chart()
    places, _, extent = _core.chart_coordinates(points, nodes, 2, 9.0, 1)
    source = _core.rasterise_chart(places, *extent[:2], 0.35, 2.5, 24, 30, 2)
    twin = reference.rasterise(places.astype(float), np.array(extent[:2]), 0.35, 2.5, 24, 30)
    known = np.isfinite(source[..., 0])
    assert 100 < known.sum() < known.size
    # The kernel is generous by 1e-4 of a triangle: pixels exactly on a rim may differ.
    assert (known != np.isfinite(twin[..., 0])).sum() <= 2
    both = known & np.isfinite(twin[..., 0])
    np.testing.assert_allclose(source[both], twin[both], atol=RASTER_TOLERANCE)
    for found, expected in zip(
        _core.chart_surface(source, points, normals, nodes, 2, 1),
        reference.surface(source, points, normals, nodes, 2),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, atol=RASTER_TOLERANCE)


def test_the_kernels_give_the_same_bytes_for_any_number_of_threads():
    m = sheets.quiet("a")
    surface = fit_surface(m)
    charts = plan_charts(m, surface)
    drawn = [texture_images(m, surface, local_contrast(m), sheets.PITCH_MM, charts, n)[0] for n in (1, 3)]
    for name in ("value", "sigma", "mask", "source_px"):
        one, other = (getattr(image, name) for image in drawn)
        assert one.tobytes() == other.tobytes(), name


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
    charts = plan_charts(plate, surface)
    drawn = [texture_images(m, surface, local_contrast(m, options, surface), pitch, charts)[0] for m in seen]
    inner = cv2.erode(drawn[0].mask.astype(np.uint8), np.ones((15, 15))) > 0
    scatter = np.var([i.value[inner] for i in drawn], axis=0, ddof=1).mean()
    stated = np.mean([i.sigma[inner] ** 2 for i in drawn])
    assert 0.93 < np.sqrt(scatter / stated) < 1.05


def test_pictures_are_not_mirrored_and_upright_as_the_camera_sees_them(bent):
    assert np.nanmedian(np.diff(bent.source_px[..., 0], axis=1)) > 0
    assert np.nanmedian(np.diff(bent.source_px[..., 1], axis=0)) > 0


def area_mm2(m):
    p = m.points_sensor.astype(float)
    return np.linalg.norm(np.cross(p[:-1, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, :-1]), axis=2).sum()


def test_texture_pixels_lie_on_the_surface_at_the_pixel_they_were_taken_from(bent):
    points = bent.points_at(*np.nonzero(bent.mask))
    height = synthetic.height(points[:, 0], points[:, 1], sheets.BENT)
    assert np.abs(points[:, 2] - height).max() < SURFACE_TOLERANCE_MM
    camera = sheets.quiet("a").camera
    np.testing.assert_allclose(camera.project(points), bent.source_px[bent.mask], atol=PIXEL_TOLERANCE)
    # Nothing of the surface is missing but a rim of two pixels, nothing beyond it is invented.
    assert bent.mask.sum() * bent.pitch_mm**2 > 0.92 * area_mm2(sheets.quiet("a"))


def test_steps_in_the_picture_are_steps_along_the_surface(bent):
    """A sheet with a little double curvature: lengths to a per cent, x and y at right angles."""
    inner = bent.mask[:-1, :-1] & bent.mask[1:, :-1] & bent.mask[:-1, 1:]
    points = bent.surface.at(bent.source_px)[0].astype(float)
    x, y = np.diff(points, axis=1)[:-1][inner], np.diff(points, axis=0)[:, :-1][inner]
    for steps in (x, y):
        np.testing.assert_allclose(np.linalg.norm(steps, axis=1) / bent.pitch_mm, 1, atol=0.03)
    assert np.abs((x * y).sum(1)).max() / bent.pitch_mm**2 < 0.03


def test_a_place_of_the_picture_is_located_with_its_frame(bent):
    rows, columns = np.nonzero(bent.mask)
    middle = np.array([columns.mean(), rows.mean()])
    xy = middle + np.array([[0, 0], [10.3, -4.7], [-20.5, 8.25], [1e4, 3]])
    angle = np.array([0.0, 1.2, -2.5, 0.3])
    points, frames, pixels = bent.locate(xy, angle)
    for found in (points, frames, pixels):
        assert np.isnan(found[3]).all()
        assert np.isfinite(found[:3]).all()
    np.testing.assert_allclose(frames[:3].transpose(0, 2, 1) @ frames[:3], np.tile(np.eye(3), (3, 1, 1)), atol=1e-6)
    assert (np.linalg.det(frames[:3]) > 0).all()
    camera = sheets.quiet("a").camera
    assert ((camera.center_sensor - points[:3]) * frames[:3, :, 2]).sum(1).min() > 0
    np.testing.assert_allclose(camera.project(points[:3]), pixels[:3], atol=PIXEL_TOLERANCE)
    step = 3.0
    ahead, _, _ = bent.locate(xy + step * np.column_stack([np.cos(angle), np.sin(angle)]), angle)
    moved = (ahead - points)[:3] / (step * bent.pitch_mm)
    # Over 6 mm the sheet bends by less than a hundredth.
    np.testing.assert_allclose(moved, frames[:3, :, 0], atol=0.03)


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


def without_slow_part(raster, reduction=10):
    """What one pass of the shading's low-pass leaves of a raster."""
    small = cv2.resize(raster, None, fx=1 / reduction, fy=1 / reduction, interpolation=cv2.INTER_AREA)
    sigma = PhotometricOptions().shading_mm / (reduction * synthetic.RASTER_PITCH_MM)
    return raster - cv2.resize(cv2.GaussianBlur(small, (0, 0), sigma), raster.shape[::-1])


def test_the_picture_shows_the_texture_that_is_on_the_part(bent):
    """It correlates with the raster at the place its own metric coordinates name, and less one pixel beside it."""
    points = bent.points_at(*np.nonzero(bent.mask))
    truth = without_slow_part(without_slow_part(cv2.GaussianBlur(sheets.grain(), (0, 0), 6)))

    def correlation(dx, dy):
        at = (points[:, :2] + [dx, dy] + synthetic.RASTER_MM) / synthetic.RASTER_PITCH_MM
        column, row = np.rint(at).astype(int).T
        return np.corrcoef(truth[row, column], bent.value[bent.mask])[0, 1]

    here = correlation(0, 0)
    assert here > 0.8
    assert all(correlation(dx, dy) < here for dx, dy in ((0.7, 0), (-0.7, 0), (0, 0.7), (0, -0.7)))
