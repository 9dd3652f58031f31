"""Groups of measurements tied together by accepted pairs, their reference and start transforms."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from planish.geometry import Array, invert
from planish.registration.result import PairResult

#: (pair, cost of the edge) per neighbour name.
_Edges = dict[str, dict[str, tuple[PairResult, float]]]


def find_groups(names: Sequence[str], pairs: Sequence[PairResult]) -> list[list[str]]:
    """Return groups of connected names: largest first, then by name; names sorted within a group."""
    edges = _edges(names, pairs)
    left, groups = set(names), []
    for start in sorted(names):
        if start not in left:
            continue
        left.discard(start)
        group, queue = [start], [start]
        while queue:
            new = [name for name in edges[queue.pop()] if name in left]
            left.difference_update(new)
            group += new
            queue += new
        groups.append(sorted(group))
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def choose_reference(group: Sequence[str], pairs: Sequence[PairResult]) -> str:
    """Return the most central measurement: least sum of path uncertainties to all others, then by name.

    Of many, every n-th by name stands for all others: the time grows with their number, not with its square.
    """
    names = sorted(group)
    index = {name: i for i, name in enumerate(names)}
    edges = [
        (index[a], index[b], cost) for a, others in _edges(names, pairs).items() for b, (_, cost) in others.items()
    ]
    if not edges:
        return names[0]
    i, j, costs = zip(*edges, strict=True)
    graph = coo_array((costs, (i, j)), shape=(len(names),) * 2).tocsr()
    others = np.arange(0, len(names), -(-len(names) // _ASKED))
    distances = dijkstra(graph, directed=True, indices=others)
    return names[int(np.argmin(np.round(distances.sum(0), 9)))]


#: Measurements that centrality is asked of, at most: the sum over 200 of them is known to a few per cent.
_ASKED = 200


def spanning_tree(group: Sequence[str], reference: str, pairs: Sequence[PairResult]) -> dict[str, PairResult | None]:
    """Return per name the last pair on the most certain path from the reference, those nearer to it first."""
    edges = _edges(group, pairs)
    tree: dict[str, PairResult | None] = {}
    last: dict[str, PairResult | None] = {reference: None}
    queue, best = [(0.0, reference)], {reference: 0.0}
    while queue:
        cost, name = heapq.heappop(queue)
        if name in tree:
            continue
        tree[name] = last[name]
        for other, (pair, edge) in edges[name].items():
            if cost + edge < best.get(other, np.inf):
                best[other], last[other] = cost + edge, pair
                heapq.heappush(queue, (cost + edge, other))
    return tree


def start_transforms(group: Sequence[str], reference: str, pairs: Sequence[PairResult]) -> dict[str, Array]:
    """Return T_world_measurement (4, 4) per name along the most certain paths from the reference (world)."""
    transforms = {reference: np.eye(4)}
    for name, pair in spanning_tree(group, reference, pairs).items():
        if pair is not None:
            assert pair.T_a_b is not None
            transforms[name] = (
                transforms[pair.a] @ pair.T_a_b if pair.b == name else transforms[pair.b] @ invert(pair.T_a_b)
            )
    return transforms


def _edges(names: Sequence[str], pairs: Sequence[PairResult]) -> _Edges:
    edges: _Edges = {name: {} for name in names}
    for pair in pairs:
        if not pair.used or pair.T_a_b is None or pair.covariance_noise is None:
            continue
        if pair.a not in edges or pair.b not in edges:
            continue
        # Uncertainty of the position at the overlap plus a constant, so that short paths win among good pairs.
        cost = float(np.sqrt(np.trace(pair.covariance_noise[3:, 3:]))) + 0.01
        edges[pair.a][pair.b] = edges[pair.b][pair.a] = (pair, cost)
    return edges
