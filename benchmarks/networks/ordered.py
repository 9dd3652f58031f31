"""The order of pairs: how often measurements are prepared, on drawn graphs, by how many a process keeps."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from networks.drawn import panel
from planish.pipeline.schedule import Pair, blocks, preparations

#: Measurements that a process keeps: a worker and a machine of 24 GiB at full resolution, any process at a low one.
KEPT = (3, 20, 63)


def named(numbers: Any) -> list[Pair]:
    """Return pairs of numbers as pairs of names, each once, sorted."""
    return sorted({(f"m{min(pair):04d}", f"m{max(pair):04d}") for pair in numbers if pair[0] != pair[1]})


def graphs() -> dict[str, list[Pair]]:
    """Return pairs by what they are drawn of."""
    rng = np.random.default_rng(1)
    number = rng.permutation(300).tolist()
    near = [(number[i], number[(i + step) % 300]) for i in range(300) for step in (1, 2)]
    place = rng.random((1000, 2))
    distance = ((place[:, None] - place) ** 2).sum(2)[np.triu_indices(1000, 1)]
    nearest = np.transpose(np.triu_indices(1000, 1))[np.argsort(distance)[:6000]]
    return {
        "panel of 20 x 20, neighbours and corners": panel(20, 20, 1).overlaps,
        "panel of 40 x 25, neighbours and corners": panel(40, 25, 1).overlaps,
        "ring of 300, two on each side": named(near),
        "1000 at random places, 12 neighbours each": named(nearest.tolist()),
        "400 with 4 partners each by lot": named(rng.integers(0, 400, (800, 2)).tolist()),
        "all pairs of 40": named(combinations(range(40), 2)),
    }


def orders() -> list[dict[str, Any]]:
    """Return preparations per measurement of all graphs, and the least that any order could need."""
    rows = []
    for name, pairs in graphs().items():
        measurements = len({one for pair in pairs for one in pair})
        for kept in KEPT:
            found = preparations([pair for block in blocks(pairs, 1, kept) for pair in block], kept)
            # Each measurement once at least, and one that is prepared meets no more than those kept beside it.
            least = max(1.0, len(pairs) / (kept - 1) / measurements)
            rows.append(
                {
                    "graph": name, "pairs": len(pairs), "each": 2 * len(pairs) / measurements, "kept": kept,
                    "prepared": found / measurements, "sorted": preparations(pairs, kept) / measurements,
                    "least": least,
                }
            )  # fmt: skip
    return rows
