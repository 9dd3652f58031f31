"""Which pairs are tried: all of few measurements, of many those that see the same places."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest

from planish.registration.candidates.choose import CandidateOptions, best_partners, choose_pairs, possible_pairs
from planish.registration.candidates.forest import nearest_of_others
from planish.registration.candidates.sample import take_sample
from planish.registration.candidates.votes import Votes, count_votes
from planish.registration.keypoints.keypoints import Keypoints, no_keypoints

#: Places that a measurement of the strip sees, and that it shares with the next one.
SEEN, SHARED = 300, 100
#: Deviation of the noise of a descriptor's values, whose own deviation is 45.
NOISE = 15
FAST = CandidateOptions(exhaustive_up_to=5, partners=3, most_partners=6, descriptors=300, trees=4)


def keypoints(descriptors, chart=None, size_mm=None):
    n = len(descriptors)
    at = np.zeros(n)
    return Keypoints(
        np.zeros((n, 3)), np.zeros((n, 3, 3)), np.full(n, 4.0) if size_mm is None else size_mm, np.zeros((n, 2)),
        np.asarray(descriptors, np.uint8), np.zeros(n, np.intp) if chart is None else chart, np.zeros((n, 2)), at,
    )  # fmt: skip


def strip(measurements, seed=0):
    """Return keypoints of measurements in a row, each of which shares places with the one before and after it."""
    rng = np.random.default_rng(seed)
    step = SEEN - SHARED
    places = rng.normal(128, 45, (measurements * step + SHARED, 128))
    found = {}
    for k in range(measurements):
        seen = places[k * step : k * step + SEEN]
        noisy = np.clip(seen + rng.normal(0, NOISE, seen.shape), 0, 255)
        found[f"m{k:03d}"] = keypoints(rng.permutation(noisy.astype(np.uint8)))
    return found


def neighbours(measurements):
    names = [f"m{k:03d}" for k in range(measurements)]
    return set(pairwise(names))


def test_few_measurements_are_tried_in_all_pairs():
    found = strip(5)
    assert choose_pairs(found, FAST).pairs == list(combinations(sorted(found), 2))


def test_of_many_those_with_places_in_common_are_tried_and_most_others_are_not():
    pairs = choose_pairs(strip(40), FAST).pairs
    assert neighbours(40) <= set(pairs)
    # At most that many partners of either side.
    assert len(pairs) <= 40 * FAST.partners
    assert pairs == sorted(pairs)


def test_overlap_is_significant_and_chance_is_not():
    found = strip(40)
    votes = count_votes(take_sample(found, sorted(found), 300), 40, 4)
    beside = votes.index_b - votes.index_a == 1
    assert beside.sum() == 39
    assert votes.significance[beside].min() > FAST.min_significance
    assert votes.significance[~beside].max() < FAST.min_significance


def test_order_of_the_measurements_does_not_matter():
    found = strip(12)
    backwards = {name: found[name] for name in sorted(found, reverse=True)}
    assert choose_pairs(backwards, FAST).pairs == choose_pairs(found, FAST).pairs


def test_added_measurements_are_tried_with_those_that_were_there_and_with_each_other():
    found = strip(20)
    new = {"m007", "m008"}
    pairs = choose_pairs(found, FAST, new).pairs
    assert {("m006", "m007"), ("m007", "m008"), ("m008", "m009")} <= set(pairs)
    assert [pair for pair in pairs if not new & set(pair)] == []


def test_a_measurement_without_keypoints_costs_nothing_and_harms_nothing():
    found = strip(12) | {"m005": no_keypoints()}
    pairs = choose_pairs(found, FAST).pairs
    assert [pair for pair in pairs if "m005" in pair] == []
    assert {("m003", "m004"), ("m006", "m007")} <= set(pairs)


def test_no_keypoints_at_all_give_no_pairs():
    assert choose_pairs({f"m{k}": no_keypoints() for k in range(8)}, FAST).pairs == []


def test_significant_votes_earn_more_partners_but_not_any_number():
    index_b = np.arange(1, 11)
    votes = Votes(np.zeros(10, np.int64), index_b, np.linspace(9, 1, 10))
    of_the_first = best_partners(votes, FAST)
    # All the others name the first one among their best.
    assert len(of_the_first) == 10
    both = Votes(*np.array(list(combinations(range(12), 2))).T, np.full(66, 9.0))
    assert len(best_partners(both, FAST)) < 66
    weak = replace(both, significance=np.full(66, 1.0))
    assert len(best_partners(weak, FAST)) < len(best_partners(both, FAST))


def test_the_sample_takes_the_surest_of_every_chart_and_size():
    words = np.repeat(np.arange(200, dtype=np.uint8)[:, None], 128, axis=1)
    chart = np.repeat([0, 0, 1], [80, 80, 40])
    size_mm = np.repeat([4.0, 8.0, 4.0], [80, 80, 40])
    sample = take_sample({"a": keypoints(words, chart, size_mm)}, ["a"], 50)
    assert sample.descriptors[:, 0].tolist() == [*range(20), *range(80, 100), *range(160, 170)]


@pytest.mark.parametrize("count", [1, 7, 40, 3000])
def test_the_forest_finds_what_looking_at_all_finds(count):
    rng = np.random.default_rng(1)
    places = rng.normal(128, 45, (count, 128))
    both = np.concatenate([places, places + rng.normal(0, NOISE, places.shape)])
    words = np.clip(both, 0, 255).astype(np.uint8)
    owner = np.repeat([0, 1], count).astype(np.int32)
    squared, index = nearest_of_others(words, owner, 1, 8)
    right = index[:, 0] == np.roll(np.arange(2 * count), count)
    # Trees miss some: voting needs a few of many.
    assert right.mean() > (0.5 if count > 1000 else 0.9)
    difference = words[right].astype(int) - words[index[right, 0]]
    np.testing.assert_array_equal(squared[right, 0], (difference**2).sum(1))
    assert (owner[index[index[:, 0] >= 0, 0]] != owner[index[:, 0] >= 0]).all()


def test_squared_distances_are_exact_even_of_the_most_different_descriptors():
    words = np.repeat(np.array([[0], [255]], np.uint8), 128, axis=1)[np.arange(20) // 10]
    squared, _ = nearest_of_others(words, np.arange(20, dtype=np.int32), 15, 2)
    assert set(np.unique(squared)) == {0, 128 * 255**2}


def test_false_alarms_are_counted_over_all_pairs_there_are():
    assert [possible_pairs(n) for n in (1, 2, 40)] == [0, 1, 780]
