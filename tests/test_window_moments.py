"""Sums over windows around every n-th pixel."""

from __future__ import annotations

import numpy as np
import pytest

from planish import _core
from reference.refinement import window_moments

TAPS = [[0.1, 0.5, 1.0, 0.4, 0.2], [-2.0, -1.0, 0.0, 1.5, 2.0]]
PAIRS = [(0, 0), (1, 0), (0, 1)]
#: Of sums of 25 float32 products.
ROUNDING = 1e-5


@pytest.fixture
def image():
    return np.random.default_rng(2).standard_normal((47, 75)).astype(np.float32)


@pytest.mark.parametrize(("step", "shape"), [(1, (47, 75)), (2, (24, 38)), (5, (10, 15)), (3, (17, 26))])
def test_sums_are_those_of_the_twin(image, step, shape):
    found = _core.window_moments(image, TAPS, PAIRS, step, shape, 2)
    np.testing.assert_allclose(found, window_moments(image, TAPS, PAIRS, step, shape), atol=ROUNDING)


def test_a_window_larger_than_the_image_sees_all_of_it(image):
    wide = [[1.0] * 201]
    found = _core.window_moments(image, wide, [(0, 0)], 40, (2, 2), 1)
    np.testing.assert_allclose(found, image.sum(dtype=float), rtol=1e-4)


def test_the_number_of_threads_changes_nothing(image):
    assert len({_core.window_moments(image, TAPS, PAIRS, 2, (24, 38), n).tobytes() for n in (1, 2, 7)}) == 1
