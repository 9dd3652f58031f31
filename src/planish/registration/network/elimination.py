"""In which order the unknowns of sparse symmetric equations are eliminated, and what that fills."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Elimination:
    """The pattern of L in P N P' = L L', n blocks square.

    Parameters
    ----------
    order : ndarray (n,) of int
        order[k] is the unknown that is eliminated as the k-th.
    starts, below : ndarray (n + 1,), (r,) of int
        below[starts[k]:starts[k + 1]] are the rows > k of column k's blocks below the diagonal, rising.
    """

    order: Indices
    starts: Indices
    below: Indices

    @property
    def rank(self) -> Indices:
        """Return by unknown when it is eliminated (n,)."""
        rank = np.empty(len(self.order), np.int64)
        rank[self.order] = np.arange(len(self.order))
        return rank


def eliminate(n: int, i: Indices, j: Indices) -> Elimination:
    """Return the order of least degree (Tinney and Walker 1967; ties: the first unknown) and what it fills.

    Parameters
    ----------
    n : int
        Unknowns.
    i, j : ndarray (m,) of int
        Where the equations have blocks beside the diagonal.
    """
    beside: list[set[int]] = [set() for _ in range(n)]
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        beside[a].add(b)
        beside[b].add(a)
    queue = [(len(item), v) for v, item in enumerate(beside)]
    heapq.heapify(queue)
    order: list[int] = []
    reached: list[list[int]] = [[] for _ in range(n)]
    gone = [False] * n
    while queue:
        degree, v = heapq.heappop(queue)
        if gone[v] or degree != len(beside[v]):
            continue
        gone[v] = True
        order.append(v)
        reached[v] = list(beside[v])
        for u in reached[v]:
            beside[u] |= beside[v]
            beside[u] -= {u, v}
            heapq.heappush(queue, (len(beside[u]), u))
    order = _children_first(order, reached)
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    below = [np.sort(rank[np.asarray(reached[v], np.int64)]) for v in order]
    starts = np.concatenate([[0], np.cumsum([len(rows) for rows in below])]).astype(np.int64)
    return Elimination(np.asarray(order, np.int64), starts, np.concatenate([np.empty(0, np.int64), *below]))


def _children_first(order: Sequence[int], reached: Sequence[Sequence[int]]) -> list[int]:
    """Return the same elimination with each unknown right after all that lead to it: what L holds stays the same."""
    when = {v: k for k, v in enumerate(order)}
    children: list[list[int]] = [[] for _ in order]
    roots = []
    for v in order:
        if reached[v]:
            children[min(reached[v], key=when.__getitem__)].append(v)
        else:
            roots.append(v)
    found, stack = [], roots
    while stack:
        v = stack.pop()
        found.append(v)
        stack += children[v]
    return found[::-1]


def supernodes(starts: Indices, below: Indices) -> Indices:
    """Return where supernodes begin, and n: columns one after the other that reach the same rows below them all.

    Their blocks are dense, and are worked on as one (Ng and Peyton 1993).
    """
    count = np.diff(starts)
    columns = np.flatnonzero(count[:-1] == count[1:] + 1)
    # Rows of a column beyond its first one are rows of that one: as many are the same.
    joined = columns[below[starts[columns]] == columns + 1] + 1
    first = np.ones(len(count) + 1, bool)
    first[joined] = False
    return np.flatnonzero(first)
