"""What the refinement sees of every n-th pixel of a measurement."""

from __future__ import annotations

import numpy as np
import pytest

import sheets
from planish import _core
from planish.registration.surface import fit_surface
from reference import joint as reference
from reference import surface as surface_reference

BLUR, BLUR_SIGMA = 0.3, 0.15
#: float32 points at 700 mm, and variances of some 1e-3 mm^2 made from them.
POINT_TOLERANCE_MM, RELATIVE_TOLERANCE = 1e-4, 1e-4
#: Channels that are no point and no gradient.
OTHERS = [3, 4, 5, 6, 7, 11]
#: The texture itself tells them.
NO_SLOPES = np.empty((0, 0, 2), np.float32)


@pytest.fixture(scope="module")
def maps():
    m, rng = sheets.noisy(sheets.quiet("b"), 1), np.random.default_rng(2)
    surface = fit_surface(m)
    texture, by_blur, by_spline = (rng.standard_normal(m.shape).astype(np.float32) for _ in range(3))
    texture[40:60, 30:90] = np.nan
    sigma = rng.uniform(0.001, 0.01, m.shape).astype(np.float32)
    points, moved = np.ascontiguousarray(m.points_sensor), (0.01 * by_blur, 0.01 * by_spline)
    return points, m.sigma_mm, surface.normals_sensor, surface.tangents_sensor, moved[0], sigma, texture, moved[1]


def values_of(maps, centre, spacing, threads=2, slopes=NO_SLOPES):
    texture = np.ascontiguousarray(maps[6][::spacing, ::spacing])
    if spacing > 1 and slopes is NO_SLOPES:
        slopes = np.zeros((*texture.shape, 2), np.float32)
    return _core.joint_values((*maps[:6], maps[7]), texture, slopes, centre, BLUR, BLUR_SIGMA, spacing, threads)


@pytest.mark.parametrize("spacing", [1, 2, 4])
def test_values_are_those_of_the_twin(maps, spacing):
    centre = np.array([-80.0, 3.0, 5.0])
    found = values_of(maps, centre, spacing)
    expected = reference.level_values(maps, centre, BLUR, BLUR_SIGMA, spacing)
    np.testing.assert_allclose(found[..., :3], expected[..., :3], atol=POINT_TOLERANCE_MM)
    np.testing.assert_allclose(found[..., OTHERS], expected[..., OTHERS], rtol=RELATIVE_TOLERANCE, atol=1e-9)


def test_the_gradient_is_that_of_the_whole_resolution(maps):
    agree_with_the_twin(maps, values_of(maps, np.zeros(3), 1)[..., 8:11], 1)


def test_given_slopes_make_the_gradient(maps):
    # What the texture itself tells them to be.
    slopes = np.stack([reference.slopes(maps[6], axis)[::4, ::4] for axis in (1, 0)], -1).astype(np.float32)
    agree_with_the_twin(maps, values_of(maps, np.zeros(3), 4, slopes=slopes)[..., 8:11], 4)


def agree_with_the_twin(maps, found, spacing):
    inner = np.s_[1:-1, 1:-1]
    rows, columns = (index + 1 for index in np.nonzero(np.isfinite(maps[0][::spacing, ::spacing, 0][inner])))
    assert len(rows) > 1000
    for k in range(0, len(rows), 97):
        v, u = rows[k], columns[k]
        expected = surface_reference.gradient_of_pixel(maps[6], maps[3], spacing * u, spacing * v)
        np.testing.assert_allclose(found[v, u], expected, rtol=1e-3, atol=1e-5)  # float32 products


def test_the_number_of_threads_changes_nothing(maps):
    assert len({values_of(maps, np.zeros(3), 1, threads).tobytes() for threads in (1, 2, 5)}) == 1
