"""Spectra at cells of several frequencies, and back."""

from __future__ import annotations

import numpy as np
import pytest

from planish import _core
from planish.registration.refine.spectrum import Grid
from reference.refinement import spectrum_cells

SHAPE = (24, 36)
#: Of float32 transforms.
ROUNDING = 1e-4


@pytest.fixture
def images():
    return np.random.default_rng(3).standard_normal((2, *SHAPE)).astype(np.float32)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_products_of_spectra_are_averaged_under_triangles(images, step):
    grid = Grid(SHAPE, step)
    first, second = (np.fft.fft2(image.astype(float)) for image in images)
    found = _core.spectrum_products(grid.transform(images[0]), grid.transform(images[1]), step, 2)
    expected = spectrum_cells((first * second.conj()).real, step)
    np.testing.assert_allclose(found, expected, atol=ROUNDING * np.abs(expected).max())


@pytest.mark.parametrize("step", [1, 2, 3])
def test_the_weight_of_a_frequency_lies_between_those_of_the_cells_and_spares_what_is_slow(images, step):
    grid, shading_px = Grid(SHAPE, step), 2.5
    rows, columns = SHAPE[0] // step, SHAPE[1] // step // 2 + 1
    cells = np.random.default_rng(4).random((rows, columns)).astype(np.float32)
    spectrum = grid.transform(images[0])
    before = spectrum.copy()
    _core.weigh_spectrum(spectrum, cells, step, shading_px, 2)
    at_v, at_u = np.arange(SHAPE[0]) / step, np.arange(SHAPE[1] // 2 + 1) / step
    along = np.array([np.interp(at_u, np.arange(columns), line) for line in cells])
    weight = np.array([np.interp(at_v, np.arange(rows + 1), column) for column in np.vstack([along, along[:1]]).T]).T
    squared = np.fft.fftfreq(SHAPE[0])[:, None] ** 2 + np.fft.rfftfreq(SHAPE[1])[None] ** 2
    weight = weight * (1 - np.exp(-0.5 * (2 * np.pi * shading_px) ** 2 * squared))
    np.testing.assert_allclose(spectrum, before * weight[..., None], atol=ROUNDING * np.abs(before).max())


@pytest.mark.parametrize("shape", [(1038, 1388), (97, 113), (3000, 4096)])
def test_the_highest_frequencies_are_cells(shape):
    grid = Grid.of(shape)
    assert grid.size[0] >= shape[0]
    assert grid.size[1] >= shape[1]
    assert grid.size[0] % grid.step == 0
    assert grid.size[1] % (2 * grid.step) == 0


def test_a_transform_and_its_inverse_cancel(images):
    grid = Grid(SHAPE)
    np.testing.assert_allclose(grid.inverse(grid.transform(images[0])), images[0], atol=ROUNDING)


def test_the_number_of_threads_changes_nothing(images):
    grid = Grid(SHAPE, 2)
    first, second = (grid.transform(image) for image in images)
    cells = np.random.default_rng(4).random((12, 10)).astype(np.float32)
    products, weighed = set(), set()
    for threads in (1, 2, 5):
        products.add(_core.spectrum_products(first, second, 2, threads).tobytes())
        spectrum = first.copy()
        _core.weigh_spectrum(spectrum, cells, 2, 1.5, threads)
        weighed.add(spectrum.tobytes())
    assert len(products) == len(weighed) == 1
