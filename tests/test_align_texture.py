"""Where the pixels of a texture image lie in another measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sheets
from planish import _core
from planish.geometry import invert, perturb
from reference import locate as reference

GATE_MM = 0.5
#: float32 of a pixel's coordinate.
PIXEL_TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def prepared():
    return sheets.pair()


def located(image, own, b, T_a_b, threads=2):
    return _core.locate_texture(
        image.source_px, own.view(np.uint8), image.surface.points_sensor, image.surface.normals_sensor,
        b.camera.kernel_parameters, b.points_sensor, invert(T_a_b), GATE_MM, threads,
    )  # fmt: skip


def test_pixels_lie_where_the_twin_finds_them(prepared):
    a, b = prepared
    image, m = a.images[0], b.measurement
    points = m.points_sensor.copy()
    points[::7, ::5] = np.nan
    m = replace(m, points_sensor=points)
    # Tilted so that the gate cuts the common region.
    T = perturb(sheets.T_TRUE, [0, 0.01, 0, 0.5, 0, 0], [0, 0, 0])
    own = image.mask & (np.arange(image.mask.shape[1]) % 9 > 2)
    found, expected = located(image, own, m, T), reference.locate_texture(image, own, m, invert(T), GATE_MM)
    known = np.isfinite(expected[..., 0])
    assert 1000 < known.sum() < 0.9 * own.sum()
    np.testing.assert_array_equal(np.isfinite(found[..., 0]), known)
    np.testing.assert_allclose(found[known], expected[known], atol=PIXEL_TOLERANCE)


def test_a_surface_seen_from_behind_is_not_seen(prepared):
    a, b = prepared
    surface = a.images[0].surface
    image = replace(a.images[0], surface=replace(surface, normals_sensor=-surface.normals_sensor))
    assert np.isnan(located(image, image.mask, b.measurement, sheets.T_TRUE)).all()


def test_the_number_of_threads_changes_nothing(prepared):
    a, b = prepared
    image = a.images[0]
    found = {located(image, image.mask, b.measurement, sheets.T_TRUE, n).tobytes() for n in (1, 2, 5)}
    assert len(found) == 1
