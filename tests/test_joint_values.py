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


@pytest.fixture(scope="module")
def maps():
    m, rng = sheets.noisy(sheets.quiet("b"), 1), np.random.default_rng(2)
    surface = fit_surface(m)
    texture, by_blur = (rng.standard_normal(m.shape).astype(np.float32) for _ in range(2))
    texture[40:60, 30:90] = np.nan
    sigma = rng.uniform(0.001, 0.01, m.shape).astype(np.float32)
    points = np.ascontiguousarray(m.points_sensor)
    return points, m.sigma_mm, surface.normals_sensor, surface.tangents_sensor, 0.01 * by_blur, texture, sigma


@pytest.mark.parametrize("spacing", [1, 2, 4])
def test_values_are_those_of_the_twin(maps, spacing):
    centre = np.array([-80.0, 3.0, 5.0])
    found = _core.joint_values(maps, centre, BLUR, BLUR_SIGMA, spacing, 2)
    expected = reference.level_values(maps, centre, BLUR, BLUR_SIGMA, spacing)
    np.testing.assert_allclose(found[..., :3], expected[..., :3], atol=POINT_TOLERANCE_MM)
    np.testing.assert_allclose(found[..., OTHERS], expected[..., OTHERS], rtol=RELATIVE_TOLERANCE, atol=1e-9)


def test_the_gradient_is_that_of_the_whole_resolution(maps):
    found = _core.joint_values(maps, np.zeros(3), BLUR, BLUR_SIGMA, 4, 2)[..., 8:11]
    rows, columns = np.nonzero(np.isfinite(found[..., 0]))
    assert len(rows) > 1000
    for k in range(0, len(rows), 97):
        v, u = rows[k], columns[k]
        expected = surface_reference.gradient_of_pixel(maps[5], maps[3], 4 * u, 4 * v)
        np.testing.assert_allclose(found[v, u], expected, rtol=1e-3, atol=1e-5)  # float32 products


def test_the_number_of_threads_changes_nothing(maps):
    assert len({_core.joint_values(maps, np.zeros(3), BLUR, BLUR_SIGMA, 2, n).tobytes() for n in (1, 2, 5)}) == 1
