"""Another measurement's texture on the pixels of a texture image."""

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
#: What that changes of a texture, of its largest value.
VALUE_TOLERANCE = 1e-3


@pytest.fixture(scope="module")
def prepared():
    return sheets.pair()


def aligned(image, own, b, contrast, T_a_b, threads=2):
    return _core.align_texture(
        image.source_px, own.view(np.uint8), image.surface.points_sensor, image.surface.normals_sensor,
        b.camera.kernel_parameters, b.points_sensor, *contrast, invert(T_a_b), GATE_MM, threads,
    )  # fmt: skip


def test_pixels_and_texture_are_those_of_the_twin(prepared):
    a, b = prepared
    image, m = a.images[0], b.measurement
    points, sigma = m.points_sensor.copy(), b.contrast[1].copy()
    points[::7, ::5] = np.nan
    sigma[::11, ::13] = np.nan
    m, contrast = replace(m, points_sensor=points), (b.contrast[0], sigma)
    # Tilted so that the gate cuts the common region.
    T = perturb(sheets.T_TRUE, [0, 0.01, 0, 0.5, 0, 0], [0, 0, 0])
    own = image.mask & (np.arange(image.mask.shape[1]) % 9 > 2)
    source, *maps, common = aligned(image, own, m, contrast, T)
    expected = reference.align_texture(image, own, m, contrast, invert(T), GATE_MM)
    known = expected[3]
    assert 1000 < known.sum() < 0.9 * own.sum()
    np.testing.assert_array_equal(common, known)
    np.testing.assert_array_equal(np.isfinite(source[..., 0]), known)
    np.testing.assert_allclose(source[known], expected[0][known], atol=PIXEL_TOLERANCE)
    for found, wanted in zip(maps, expected[1:3], strict=True):
        np.testing.assert_allclose(found[known], wanted[known], atol=VALUE_TOLERANCE * np.abs(wanted[known]).max())
        assert not found[~known].any()


def test_a_surface_seen_from_behind_is_not_seen(prepared):
    a, b = prepared
    surface = a.images[0].surface
    image = replace(a.images[0], surface=replace(surface, normals_sensor=-surface.normals_sensor))
    source, value, sigma, common = aligned(image, image.mask, b.measurement, b.contrast, sheets.T_TRUE)
    assert np.isnan(source).all()
    assert not any(m.any() for m in (value, sigma, common))


def test_the_number_of_threads_changes_nothing(prepared):
    a, b = prepared
    image = a.images[0]
    found = {
        b"".join(m.tobytes() for m in aligned(image, image.mask, b.measurement, b.contrast, sheets.T_TRUE, n))
        for n in (1, 2, 5)
    }
    assert len(found) == 1
