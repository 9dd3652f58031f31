"""Groups of measurements tied together by accepted pairs, their reference and start transforms."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np

from planish.geometry import Array, invert
from planish.registration.result import PairResult

#: (T of the neighbour in this frame, cost of the edge) per neighbour name.
_Edges = dict[str, dict[str, tuple[Array, float]]]


def find_groups(names: Sequence[str], pairs: Sequence[PairResult]) -> list[list[str]]:
    """Return groups of connected names: largest first, then by name; names sorted within a group."""
    edges = _edges(names, pairs)
    left, groups = set(names), []
    while left:
        start = min(left)
        reached = set(_distances(edges, start))
        groups.append(sorted(reached))
        left -= reached
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def choose_reference(group: Sequence[str], pairs: Sequence[PairResult]) -> str:
    """Return the most central measurement: least sum of path uncertainties to all others, then by name."""
    edges = _edges(group, pairs)
    return min(group, key=lambda name: (round(sum(_distances(edges, name).values()), 9), name))


def start_transforms(group: Sequence[str], reference: str, pairs: Sequence[PairResult]) -> dict[str, Array]:
    """Return T_world_measurement (4, 4) per name along the most certain paths from the reference (world)."""
    edges = _edges(group, pairs)
    transforms = {reference: np.eye(4)}
    queue = [(0.0, reference, reference)]
    best = {reference: 0.0}
    while queue:
        cost, name, _ = heapq.heappop(queue)
        if cost > best[name]:
            continue
        for other, (T_name_other, edge) in edges[name].items():
            if cost + edge < best.get(other, np.inf):
                best[other] = cost + edge
                transforms[other] = transforms[name] @ T_name_other
                heapq.heappush(queue, (cost + edge, other, name))
    return transforms


def path_exists(a: str, b: str, pairs: Sequence[PairResult]) -> bool:
    """Return whether used pairs connect two measurements."""
    names = sorted({name for pair in pairs for name in (pair.a, pair.b)} | {a, b})
    return b in _distances(_edges(names, pairs), a)


def _edges(names: Sequence[str], pairs: Sequence[PairResult]) -> _Edges:
    edges: _Edges = {name: {} for name in names}
    for pair in pairs:
        if not pair.used or pair.T_a_b is None or pair.covariance_noise is None:
            continue
        if pair.a not in edges or pair.b not in edges:
            continue
        # Uncertainty of the position at the overlap plus a constant, so that short paths win among good pairs.
        cost = float(np.sqrt(np.trace(pair.covariance_noise[3:, 3:]))) + 0.01
        edges[pair.a][pair.b] = (pair.T_a_b, cost)
        edges[pair.b][pair.a] = (invert(pair.T_a_b), cost)
    return edges


def _distances(edges: _Edges, start: str) -> dict[str, float]:
    best = {start: 0.0}
    queue = [(0.0, start)]
    while queue:
        cost, name = heapq.heappop(queue)
        if cost > best[name]:
            continue
        for other, (_, edge) in edges[name].items():
            if cost + edge < best.get(other, np.inf):
                best[other] = cost + edge
                heapq.heappush(queue, (cost + edge, other))
    return best
