"""The order in which pairs are tried: how often measurements are prepared, against the least there can be."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from planish.execution.recent import Recent
from planish.pipeline.schedule import blocks, kept_in, preparations

#: Preparations against the least possible, which is reached where a front of neighbours fits into memory; where it does
#: not, what lies along the seams of strips is prepared twice.
SEAMS = 1.5
#: A random graph has no front that fits: each of its pairs with what was forgotten costs a preparation of its own.
NO_NEIGHBOURHOOD = 2.1


def sorted_pairs(numbers):
    return sorted({(f"m{min(p):04d}", f"m{max(p):04d}") for p in numbers if p[0] != p[1]})


def panel(columns, rows, seed=1):
    """All neighbours beside and some at corners, names at random."""
    rng = np.random.default_rng(seed)
    number = rng.permutation(columns * rows).reshape(columns, rows)
    found = []
    for i, j in np.ndindex(columns, rows):
        for di, dj, share in ((1, 0, 1.0), (0, 1, 1.0), (1, 1, 0.4), (1, -1, 0.4)):
            if i + di < columns and 0 <= j + dj < rows and rng.random() < share:
                found.append((int(number[i, j]), int(number[i + di, j + dj])))
    return sorted_pairs(found)


def ring(count):
    number = np.random.default_rng(2).permutation(count).tolist()
    return sorted_pairs([(number[i], number[(i + step) % count]) for i in range(count) for step in (1, 2)])


def random_graph(count, degree):
    return sorted_pairs(np.random.default_rng(3).integers(0, count, (count * degree // 2, 2)).tolist())


def ordered(pairs, kept, there=()):
    return [pair for block in blocks(pairs, 1, kept, there=there) for pair in block]


def prepared(order, kept, there=()):
    """How often a process that keeps so many measurements prepares one, by what keeps them."""
    recent, made = Recent(10**9, max_number=kept), []
    for name in there:
        recent.get(name, lambda: None)
    for pair in order:
        for name in pair:
            recent.get(name, lambda name=name: made.append(name))
    return len(made)


def least(pairs, kept):
    """Each is prepared once at least, and each preparation meets no more than those that are kept beside it."""
    return max(len({name for pair in pairs for name in pair}), -(-len(pairs) // (kept - 1)))


GRAPHS = {
    "panel": panel(40, 25), "small panel": panel(8, 5), "ring": ring(300), "random": random_graph(400, 4),
    "all pairs": list(combinations([f"m{i:02d}" for i in range(40)], 2)),
}  # fmt: skip


@pytest.mark.parametrize("kept", [2, 3, 8, 63])
@pytest.mark.parametrize("name", GRAPHS)
def test_every_pair_is_tried_once(name, kept):
    assert sorted(ordered(GRAPHS[name], kept)) == GRAPHS[name]
    assert ordered(GRAPHS[name][::-1], kept) == ordered(GRAPHS[name], kept)


@pytest.mark.parametrize(
    ("name", "kept"), [("panel", 63), ("small panel", 16), ("ring", 8), ("all pairs", 63), ("random", 401)]
)
def test_each_measurement_is_prepared_once_where_a_front_of_neighbours_fits_into_memory(name, kept):
    assert prepared(ordered(GRAPHS[name], kept), kept) == least(GRAPHS[name], kept)


@pytest.mark.parametrize("kept", [3, 8, 20])
@pytest.mark.parametrize("name", ["panel", "small panel", "ring"])
def test_few_are_prepared_again_where_it_does_not_fit(name, kept):
    assert prepared(ordered(GRAPHS[name], kept), kept) < SEAMS * least(GRAPHS[name], kept)


@pytest.mark.parametrize("kept", [3, 8, 20, 63])
def test_pairs_without_any_neighbourhood_cost_less_than_one_preparation_each(kept):
    count = prepared(ordered(GRAPHS["random"], kept), kept)
    assert count < NO_NEIGHBOURHOOD * least(GRAPHS["random"], kept)
    assert count < len(GRAPHS["random"])


def test_what_is_kept_already_saves_preparations_where_it_lies_together_and_costs_none_where_it_does_not():
    pairs = GRAPHS["panel"]
    before = ordered(pairs, 63)[-200:]
    together = list(dict.fromkeys(name for pair in reversed(before) for name in pair))[:40][::-1]
    scattered = sorted({name for pair in pairs for name in pair})[-40:]
    assert prepared(ordered(pairs, 63, together), 63, together) <= 1000 - 40
    assert prepared(ordered(pairs, 63, scattered), 63, scattered) <= 1000
    # Those of another run are no part of it.
    assert ordered(pairs, 63, ["other"]) == ordered(pairs, 63)


@pytest.mark.parametrize("kept", [2, 3, 8])
def test_the_count_in_thought_is_that_of_what_is_kept(kept):
    there = ["m0003", "m0001"]
    order = ordered(GRAPHS["small panel"], kept, there)
    assert preparations(order, kept, there) == prepared(order, kept, there)


def test_blocks_are_small_enough_for_all_workers_and_neighbours_stay_together():
    chain = list(pairwise(f"m{i:02d}" for i in range(65)))
    found = blocks(chain, 2, 3)
    assert {len(block) for block in found} == {8}
    assert all(first[-1][1] == second[0][0] for first, second in pairwise(found))
    assert blocks([], 2, 3) == []


def test_so_many_are_kept_as_memory_holds():
    assert kept_in(2**30, 64, [78_000_000] * 3) == 3
    assert kept_in(2**30, 64, [300_000_000] * 3) == 2  # a pair has two
    assert kept_in(6 * 2**30, 64, [78_000_000] * 30) == 20
    assert kept_in(6 * 2**30, 64, [3_000_000] * 30) == 63
    assert kept_in(2**30, 64, []) == 63
