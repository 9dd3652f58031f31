"""The texture kernels against their definitions in NumPy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from planish import _core
from planish.registration.texture.lowpass import EVERYWHERE
from reference import texture as reference

#: float32 sums of some ten terms near 1.
ROUNDING = 2e-5
#: Of float32 sums whose differences are a hundredth of them.
PLANE_ROUNDING = 1e-4
#: Of float32 cosines down to a hundredth: sums of three products.
COSINE_ROUNDING = 1e-4
FACTOR, SHAPE, BLOCKS = 4, (30, 41), (8, 11)
NOTHING = np.empty((0, 0), np.float32)


def drawn(seed, shape, low, high):
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def with_gaps(image, seed):
    out = image.copy()
    out[np.random.default_rng(seed).uniform(size=image.shape) < 0.1] = np.nan
    return out


def both(kernel, twin):
    for a, b in zip(kernel, twin, strict=True):
        np.testing.assert_allclose(a, b, rtol=ROUNDING, atol=ROUNDING)


def test_block_sums_leave_out_what_is_dark_saturated_or_unknown():
    image = with_gaps(drawn(1, SHAPE, 0, 260), 2)
    both(
        _core.block_sums(image, 10, 250, EVERYWHERE, FACTOR, 2),
        reference.block_sums(image, 10, 250, EVERYWHERE, FACTOR),
    )
    part = (drawn(3, SHAPE, 0, 1) > 0.3).astype(np.uint8)
    both(_core.block_sums(image, 10, 250, part, FACTOR, 2), reference.block_sums(image, 10, 250, part, FACTOR))


def test_planes_through_blocks_are_those_of_least_squares():
    weight = np.where(drawn(1, (13, 21), 0, 1) > 0.4, 16, 0).astype(np.float32)
    weight[:, 12:] = 0
    total = weight * drawn(2, weight.shape, 50, 200)
    bell = np.exp(-0.5 * (np.arange(-4, 5) / 2.0) ** 2)
    args = (total, weight, (bell / bell.sum()).tolist(), 0.05, 0.04, 0.5)
    kernel = _core.local_planes(*args, 1)
    assert np.isnan(kernel).any()
    # Values of some hundred, so that float32 leaves a relative error.
    np.testing.assert_allclose(kernel, reference.local_planes(*args), rtol=PLANE_ROUNDING)
    assert kernel.tobytes() == _core.local_planes(*args, 3).tobytes()


def test_the_kinds_of_a_cameras_images_are_combined_as_defined():
    images = [with_gaps(drawn(k, SHAPE, 50, 200), 10 + k) for k in range(3)]
    ranges = [(60.0, 1e9), (60.0, 180.0), (70.0, 1e9)]
    level = [drawn(20 + k, BLOCKS, 80, 120) for k in range(3)]
    variance = [with_gaps(drawn(30 + k, BLOCKS, 1, 2), 50 + k) for k in range(3)]
    together = drawn(40, BLOCKS, 0, 0.9)
    for seen in (EVERYWHERE, (drawn(50, SHAPE, 0, 1) > 0.3).astype(np.uint8)):
        for count, covariance in itertools.product((1, 2, 3), (together, NOTHING)):
            kinds = (m[:count] for m in (images, ranges, level, variance))
            taken, bounds, levels, variances = kinds
            if count == 1:
                covariance = NOTHING
            args = (taken, bounds, seen, levels, variances, covariance, 0.9, FACTOR, 0.6)
            kernel = _core.camera_contrast(*args, 2)
            assert np.isnan(kernel[0]).any()
            both(kernel, reference.camera_contrast(*args))


def test_four_kinds_of_images_are_refused():
    image, blocks = drawn(1, SHAPE, 50, 200), drawn(2, BLOCKS, 1, 2)
    with pytest.raises(ValueError, match="three kinds"):
        _core.camera_contrast([image] * 4, [(0, 255)] * 4, EVERYWHERE, [blocks] * 4, [blocks] * 4, NOTHING, 1, 4, 1, 1)


def test_kinds_of_images_scatter_as_defined():
    images = [with_gaps(drawn(k, SHAPE, 50, 200), 10 + k) for k in range(2)]
    levels, expected = [drawn(20 + k, BLOCKS, 80, 120) for k in range(2)], drawn(30, BLOCKS, 0.01, 0.02)
    for step, seen in ((1, EVERYWHERE), (2, (drawn(50, SHAPE, 0, 1) > 0.3).astype(np.uint8))):
        args = (images, [(60.0, 190.0), (70.0, 1e9)], seen, levels, expected, FACTOR, step)
        both(_core.contrast_scatter(*args), reference.contrast_scatter(*args))
    nowhere = np.zeros(SHAPE, np.uint8)
    assert _core.contrast_scatter(images, [(0, 1e9)] * 2, nowhere, levels, expected, FACTOR, 1) == (0, 0)


def test_another_camera_is_read_between_its_pixels_as_defined():
    value, variance = (with_gaps(drawn(k, (33, 45), 0.1, 0.3), 5) for k in (3, 4))
    rows, columns = np.indices(SHAPE)
    place = np.stack([columns + 0.3 + 0.01 * rows, rows - 0.4], -1).astype(np.float32)
    place[3:5, 6] = np.nan
    level = drawn(9, (9, 12), 0.5, 1.5)
    for where in (place, np.empty((0, 0, 2), np.float32)):
        seen = (drawn(11, where.shape[:2] if where.size else value.shape, 0, 1) > 0.3).astype(np.uint8)
        args = (value, variance, level, FACTOR, where, seen, 0.9)
        both(_core.compensated_image(*args, 2), reference.compensated_image(*args))


def test_views_are_merged_as_defined():
    maps = [with_gaps(drawn(k, SHAPE, 0.1, 0.3), k) for k in range(4)]
    light, trust = drawn(6, BLOCKS, 0.8, 1.2), drawn(7, BLOCKS, 0, 1)
    views = [(*maps[:2], light, trust), (*maps[2:], trust + 0.5, light)]
    valid = (drawn(8, SHAPE, 0, 1) > 0.1).astype(np.uint8)
    both(_core.merge_contrasts(views, valid, FACTOR, 2), reference.merge_contrasts(views, valid, FACTOR))


@pytest.mark.parametrize("stretch", [(0.8, 0.9), (1.5, 1.2), (2.7, 1.0)])
def test_a_chart_is_sampled_as_defined(stretch):
    value, sigma = drawn(1, (60, 80), -1, 1), drawn(2, (60, 80), 0.1, 0.2)
    rows, columns = np.indices((14, 16))
    source = np.stack([15 + stretch[0] * columns, 16 + stretch[1] * rows], -1).astype(np.float32)
    known = (drawn(3, value.shape, 0, 1) > 0.05).astype(np.uint8)
    kernel = _core.sample_chart(value, sigma, known, source, 0.6, 2)
    assert 0 < kernel[2].sum() < kernel[2].size
    both(kernel, reference.sample_chart(value, sigma, known, source, np.maximum(stretch, 1), 0.6))


@pytest.mark.parametrize("member", [True, False])
def test_a_pattern_is_removed_as_defined(member):
    value, variance = drawn(1, SHAPE, -0.1, 0.1), drawn(2, SHAPE, 1e-5, 1e-4)
    own = drawn(3, BLOCKS, 1e3, 2e3) if member else np.empty((0, 0), np.float32)
    weight, total = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
    captures = [(value, own)] if member else []
    captures += [(with_gaps(drawn(10 + k, SHAPE, -0.1, 0.1), k), drawn(20 + k, BLOCKS, 1e3, 2e3)) for k in range(3)]
    for contrast, share in captures:
        _core.add_to_pattern(contrast, share, FACTOR, total, weight, 2)
    maps = [drawn(30, BLOCKS, 1e-4, 1e-3), drawn(31, BLOCKS, 0, 1e-4), drawn(32, BLOCKS, 1, 2)]
    rest, uncertain = 2 * value, variance.copy()
    _core.remove_pattern(value, own, (total, weight, *maps), FACTOR, 0.5, rest, uncertain, 2)
    cleaned, expected = reference.remove_pattern(value, variance, own, total, weight, *maps, FACTOR)
    both((rest - value, 2 * uncertain - variance), (cleaned, expected))


def test_a_contrast_is_split_into_bands_as_defined():
    value, bell = with_gaps(drawn(1, SHAPE, -0.1, 0.1), 2), [0.1, 0.2, 0.4, 0.2, 0.1]
    kernel = _core.split_bands(value, bell, FACTOR, 2)
    both(kernel, reference.split_bands(value, bell, FACTOR))
    assert all(
        one.tobytes() == other.tobytes()
        for one, other in zip(kernel, _core.split_bands(value, bell, FACTOR, 3), strict=True)
    )


def test_the_kernels_return_the_same_bytes_for_any_number_of_threads():
    value, sigma = drawn(1, (60, 80), -1, 1), drawn(2, (60, 80), 0.1, 0.2)
    source = drawn(3, (31, 33, 2), 0, 60)
    known = np.ones(value.shape, np.uint8)
    one, three = (_core.sample_chart(value, sigma, known, source, 0.6, n) for n in (1, 3))
    assert [m.tobytes() for m in one] == [m.tobytes() for m in three]
    one, three = (_core.block_sums(value, 0, 1, EVERYWHERE, 4, n) for n in (1, 3))
    assert [m.tobytes() for m in one] == [m.tobytes() for m in three]


def test_every_block_takes_its_central_pixel_or_the_last_before_it():
    image = drawn(1, (*SHAPE, 3), 0, 1)
    rows, columns = (np.minimum(np.arange(n) * 7 + 3, size - 1) for n, size in zip((5, 6), SHAPE, strict=True))
    np.testing.assert_array_equal(_core.block_centres(image, 7), image[np.ix_(rows, columns)])


def test_places_mark_the_blocks_that_they_fall_into():
    places = np.array([[[-0.5, 3.4], [3.6, 3.6], [np.nan, 1.0], [80.0, -9.0]]], np.float32)
    marked = _core.mark_blocks(places, FACTOR, *SHAPE)
    assert sorted(zip(*np.nonzero(marked), strict=True)) == [(0, 0), (0, 10), (1, 1)]


def test_gaps_are_filled_two_blocks_far():
    blocks = np.full((9, 9), np.nan, np.float32)
    blocks[4, 4], blocks[4, 5] = 1, 3
    filled = _core.fill_gaps(blocks, -1.0)
    outside = np.ones((9, 9), bool)
    outside[2:7, 2:8] = False
    assert (filled[4, 4], filled[4, 5]) == (1, 3)
    np.testing.assert_array_equal(filled == -1, outside)
    np.testing.assert_allclose(filled, reference.fill_gaps(blocks, -1.0), rtol=ROUNDING)
    holed = with_gaps(drawn(1, SHAPE, 0, 1), 2)
    np.testing.assert_allclose(_core.fill_gaps(holed, 0.5), reference.fill_gaps(holed, 0.5), rtol=ROUNDING)


def test_a_point_source_lights_a_matt_surface_as_defined():
    points, normals = drawn(1, (6, 8, 3), -100, 100), drawn(2, (6, 8, 3), -1, 1)
    points[2, 3], normals[4, 5] = np.nan, 0
    args = (points, normals, np.array([10.0, 20.0, -500.0]), 0.1)
    found, expected = _core.lambert(*args), reference.lambert(*args)
    assert np.isnan(found).sum() == 2
    np.testing.assert_allclose(found, expected, rtol=COSINE_ROUNDING)
