"""Residuals that are looked up once: their sums are those of the normal equations at the same weights."""

from __future__ import annotations

import numpy as np
import pytest

import sheets
from planish.registration.prepared import prepare
from planish.registration.refine.residuals import Weights, equations
from planish.registration.refine.samples import samples

TILE, STRIDE = 12, 3
LOOK = {"max_distance_mm": 1.0, "max_normal_rad": 0.35, "stride": STRIDE, "tile_px": TILE}
#: The equations add up to 64 float32 values before they go over to float64.
ROUNDING = 1e-5


@pytest.fixture(scope="module")
def sides():
    return [
        prepare(sheets.noisy(sheets.quiet(s, 0.0, 0.02), i, 4.0), sheets.PITCH_MM).sides[1] for i, s in enumerate("ab")
    ]


def weights_of(b, rng):
    """Weights that differ from tile to tile; some count nothing."""
    weights = Weights.alike(b, TILE)
    shape = weights.values.shape[:2]
    texture = weights.values[:, :, 1]
    texture[:] = np.stack(
        [rng.uniform(0.3, 2, shape), rng.uniform(0.2, 1, shape), *rng.normal(0, 0.2, (2, *shape))], -1
    )
    texture[rng.random(shape) < 0.2, 1] = 0
    return weights


@pytest.mark.parametrize("alike", [True, False])
def test_the_sums_of_samples_are_those_of_the_equations(sides, alike):
    a, b = sides
    weights = None if alike else weights_of(b, np.random.default_rng(1))
    found = samples(a, b, sheets.T_TRUE, **LOOK, threads=1)
    expected = equations(a, b, sheets.T_TRUE, np.zeros(3), weights, **LOOK, residuals=False, threads=1)
    sums = found.sums(weights)
    assert found.points == expected.points > 1000
    assert found.textures.shape[1] == expected.texture_points > 1000
    for name in ("sizes", "squares", "residuals"):
        value, other = getattr(sums, name), getattr(expected.sums, name)
        np.testing.assert_allclose(value, other, rtol=ROUNDING, atol=ROUNDING * np.abs(other).max(), err_msg=name)


def test_samples_are_the_same_for_any_number_of_threads(sides):
    one, three = (samples(*sides, sheets.T_TRUE, **LOOK, threads=n) for n in (1, 3))
    assert np.array_equal(one.textures, three.textures)
    assert np.array_equal(one.counts, three.counts)
    assert np.array_equal(one.tile_sizes, three.tile_sizes)


def test_where_nothing_meets_there_are_no_samples(sides):
    away = sheets.T_TRUE.copy()
    away[0, 3] += 1e4
    found = samples(*sides, away, **LOOK, threads=1)
    assert found.points == 0
    assert found.textures.shape == (3, 0)
    assert not found.sums().sizes.any()
