"""Matches: mutual, exact, and only among keypoints of the same metric size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import matched
from planish import _core
from planish.registration.match.descriptors import MatchOptions, match, nearest_neighbours
from reference import match as reference


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


@pytest.mark.parametrize("ratio", [1.0, 1.4, 5.0])
def test_nearest_descriptors_are_exactly_those_of_an_exhaustive_search(sides, ratio):
    a, b = sides
    args = (a.descriptors, a.size_mm, b.descriptors, b.size_mm, ratio)
    expected = reference.nearest(*args)
    for threads in (1, 2, 8):
        np.testing.assert_array_equal(_core.nearest_descriptors(*args, threads), expected)


def test_equal_descriptors_go_to_the_first(sides):
    a, b = sides
    same = replace(b, descriptors=np.tile(b.descriptors[:1], (len(b), 1)), size_mm=np.full(len(b), 5.0))
    found = _core.nearest_descriptors(a.descriptors, np.full(len(a), 5.0), same.descriptors, same.size_mm, 1.4, 2)
    assert (found[:, 0] == 0).all()
    assert (found[:, 1] == found[:, 2]).all()


def test_the_true_matches_are_found_and_each_keypoint_stands_once(sides):
    a, b = sides
    found = nearest_neighbours(a, b)
    assert set(range(60)) <= set(found.index_a[found.index_a == found.index_b])
    assert len(set(found.index_a)) == len(set(found.index_b)) == len(found)


def test_matches_are_mutual(sides):
    a, b = sides
    options = MatchOptions(max_ratio=1.0)
    there, back = nearest_neighbours(a, b, options), nearest_neighbours(b, a, options)
    assert set(zip(there.index_a, there.index_b, strict=True)) == set(zip(back.index_b, back.index_a, strict=True))


def test_the_best_ratio_comes_first_and_the_number_is_limited(sides):
    a, b = sides
    found = nearest_neighbours(a, b, MatchOptions(max_matches=20))
    assert len(found) == 20
    assert (np.diff(found.ratio) >= 0).all()
    everything = nearest_neighbours(a, b)
    np.testing.assert_array_equal(found.index_a, everything.index_a[:20])
    assert everything.ratio.max() <= MatchOptions().max_ratio


def test_keypoints_of_another_size_do_not_match(sides):
    a, b = sides
    larger = replace(b, size_mm=b.size_mm * 5)
    found = nearest_neighbours(a, larger)
    sizes = larger.size_mm[found.index_b] / a.size_mm[found.index_a]
    assert np.maximum(sizes, 1 / sizes).max(initial=0) <= MatchOptions().max_size_ratio
    assert not (found.index_a == found.index_b)[found.index_a < 60].any()


def test_without_keypoints_there_are_no_matches(sides):
    a, b = sides
    nothing = a.take(np.zeros(len(a), bool))
    assert len(match(nothing, b)) == len(match(b, nothing)) == 0
