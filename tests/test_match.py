"""Descriptors suggest pairs of keypoints: exact, both ways, and only among keypoints of the same metric size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import matched
from planish import _core
from planish.registration.match.descriptors import nearest_neighbours
from reference import match as reference

RATIO = 1.4


@pytest.fixture(scope="module")
def sides():
    """Keypoints of which the first 60 are the same in both, with other sizes and descriptors a little changed."""
    rng = np.random.default_rng(4)
    a, b = matched.random_side(rng, 150), matched.random_side(rng, 130)
    descriptors = b.descriptors.copy()
    descriptors[:60] = np.clip(a.descriptors[:60].astype(int) + rng.integers(-20, 21, (60, 128)), 0, 255)
    size_a, size_b = rng.uniform(3, 12, 150), rng.uniform(3, 12, 130)
    size_b[:60] = size_a[:60] * rng.uniform(0.8, 1.25, 60)
    return replace(a, size_mm=size_a), replace(b, size_mm=size_b, descriptors=descriptors)


def neighbours(a, b, ratio=RATIO, count=1000):
    return nearest_neighbours(a, b, ratio, count, 2)


@pytest.mark.parametrize("ratio", [1.0, 1.4, 5.0])
def test_nearest_descriptors_are_exactly_those_of_an_exhaustive_search_both_ways(sides, ratio):
    a, b = sides
    args = (a.descriptors, a.size_mm, b.descriptors, b.size_mm, ratio)
    forward, backward = reference.nearest(*args), reference.nearest(*args[2:4], *args[:2], ratio)
    for threads in (1, 2, 8):
        found = _core.nearest_descriptors(*args, threads)
        np.testing.assert_array_equal(found[0], forward)
        np.testing.assert_array_equal(found[1], backward)


def test_nearest_descriptors_are_exact_beyond_one_tile_and_at_the_largest_values():
    rng = np.random.default_rng(5)
    # Few different values: many distances are equal, and the largest is what float32 must hold.
    a, b = (rng.choice([0, 254, 255], (n, 128)).astype(np.uint8) for n in (300, 530))
    a[7], b[3] = 0, 255
    b[100:104] = b[100]
    size_a, size_b = rng.uniform(3, 9, 300), rng.uniform(3, 9, 530)
    found = _core.nearest_descriptors(a, size_a, b, size_b, 2.0, 2)
    np.testing.assert_array_equal(found[0], reference.nearest(a, size_a, b, size_b, 2.0))
    np.testing.assert_array_equal(found[1], reference.nearest(b, size_b, a, size_a, 2.0))


def test_equal_descriptors_go_to_the_first(sides):
    a, b = sides
    same = replace(b, descriptors=np.tile(b.descriptors[:1], (len(b), 1)), size_mm=np.full(len(b), 5.0))
    found, _ = _core.nearest_descriptors(a.descriptors, np.full(len(a), 5.0), same.descriptors, same.size_mm, RATIO, 2)
    assert (found[:, 0] == 0).all()
    assert (found[:, 1] == found[:, 2]).all()


def test_the_true_pairs_are_found_and_stand_first(sides):
    found = neighbours(*sides)
    true = found.index_a == found.index_b
    assert set(range(60)) <= set(found.index_a[true])
    assert true[:60].all()


def test_each_pair_is_the_nearest_of_one_side_and_stands_once(sides):
    a, b = sides
    found = neighbours(a, b)
    forward, backward = _core.nearest_descriptors(a.descriptors, a.size_mm, b.descriptors, b.size_mm, RATIO, 1)
    of_a = forward[found.index_a, 0] == found.index_b
    of_b = backward[found.index_b, 0] == found.index_a
    assert (of_a | of_b).all()
    np.testing.assert_array_equal(found.mutual, of_a & of_b)
    assert len(set(zip(found.index_a, found.index_b, strict=True))) == len(found)
    assert len(found) == (forward[:, 0] >= 0).sum() + (backward[:, 0] >= 0).sum() - found.mutual.sum()


def test_neighbours_are_the_same_seen_from_the_other_side(sides):
    a, b = sides
    there, back = neighbours(a, b), neighbours(b, a)
    assert set(zip(there.index_a, there.index_b, strict=True)) == set(zip(back.index_b, back.index_a, strict=True))


def test_mutual_pairs_come_first_then_the_best_ratio_and_the_number_is_limited(sides):
    everything, found = neighbours(*sides), neighbours(*sides, count=20)
    assert len(found) == 20
    np.testing.assert_array_equal(found.index_a, everything.index_a[:20])
    assert (np.diff(everything.mutual.astype(int)) <= 0).all()
    for group in (everything.mutual, ~everything.mutual):
        assert (np.diff(everything.ratio[group]) >= 0).all()


def test_keypoints_of_another_size_are_no_neighbours(sides):
    a, b = sides
    larger = replace(b, size_mm=b.size_mm * 5)
    found = neighbours(a, larger)
    sizes = larger.size_mm[found.index_b] / a.size_mm[found.index_a]
    assert np.maximum(sizes, 1 / sizes).max(initial=0) <= RATIO
    assert not (found.index_a == found.index_b)[found.index_a < 60].any()


def test_without_keypoints_there_are_no_neighbours(sides):
    a, b = sides
    nothing = a.take(np.zeros(len(a), bool))
    assert len(neighbours(nothing, b)) == len(neighbours(b, nothing)) == 0
