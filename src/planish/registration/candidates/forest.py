"""Nearest descriptors of other measurements among millions, approximately: a forest of random trees.

A tree splits the descriptors at the median of their projection on the difference of two of them, drawn at random, until
leaves are small; neighbours are sought within the leaves of several trees (Dasgupta and Freund, Random projection trees
and low dimensional manifolds, STOC 2008; Bernhardsson's Annoy). Time grows with M log M. All arithmetic is in whole
numbers that float32 holds exactly (128 products of differences of bytes stay below 2^24), and what is drawn depends on
the number of the tree alone: the result is the same on any machine, for any number of threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Descriptors of a leaf at most.
_LEAF = 32
#: Leaves, and descriptors, that are worked on at once: what is held beside the descriptors.
_LEAVES_AT_ONCE, _ROWS_AT_ONCE = 1024, 1 << 16
#: Nodes of a level up to which each is projected on its own.
_FEW_NODES = 1024
#: No neighbour.
_NONE = np.iinfo(np.int64).max

Keys = NDArray[np.int64]


def nearest_of_others(
    descriptors: NDArray[np.uint8], owner: NDArray[np.int32], count: int, trees: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return squared distances and indices (M, count) of the nearest descriptors of other owners; -1 where none is."""
    # Distance and index in one number: sorting it sorts both, and ties have one order.
    found = np.full((len(descriptors), count), _NONE)
    norms = np.einsum("ij,ij->i", descriptors, descriptors, dtype=np.int64, casting="unsafe").astype(np.float32)
    for tree in range(trees if len(descriptors) > 1 else 0):
        order, starts = _leaves(descriptors, np.random.Generator(np.random.Philox(key=tree)))
        for first in range(0, len(starts) - 1, _LEAVES_AT_ONCE):
            bounds = starts[first : first + _LEAVES_AT_ONCE + 1]
            member = bounds[:-1, None] + np.arange(np.diff(bounds).max())
            member = np.where(member < bounds[1:, None], order[np.minimum(member, len(order) - 1)], -1)
            _search_leaves(found, descriptors, norms, owner, member)
    none = found == _NONE
    return np.where(none, -1, found >> 32), np.where(none, -1, found & 0xFFFFFFFF)


def _search_leaves(
    found: Keys,
    descriptors: NDArray[np.uint8],
    norms: NDArray[np.float32],
    owner: NDArray[np.int32],
    member: NDArray[np.int64],
) -> None:
    """Add to `found` what leaves hold; `member` (leaves, size) are indices, -1 where there is none."""
    count = found.shape[1]
    x = descriptors[member].astype(np.float32)
    squared = norms[member][:, :, None] + norms[member][:, None, :] - 2 * (x @ x.transpose(0, 2, 1))
    key = (squared.astype(np.int64) << 32) | member[:, None, :]
    there = member >= 0
    other = owner[member][:, :, None] != owner[member][:, None, :]
    key[~(other & there[:, None, :])] = _NONE
    if key.shape[2] > count:
        key = np.partition(key, count - 1, axis=2)[:, :, :count]
    rows = member[there]
    both = np.sort(np.concatenate([found[rows], key[there]], axis=1), axis=1)
    both[:, 1:][both[:, 1:] == both[:, :-1]] = _NONE
    both.sort(axis=1)
    found[rows] = both[:, :count]


def _leaves(descriptors: NDArray[np.uint8], rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the descriptors' indices leaf by leaf, and where leaves begin and the last one ends."""
    total = len(descriptors)
    order, starts = np.arange(total), np.array([0, total])
    while (sizes := np.diff(starts)).max() > _LEAF:
        ends = [order[starts[:-1] + (rng.random(len(sizes)) * sizes).astype(np.int64)] for _ in range(2)]
        direction = descriptors[ends[0]].astype(np.float32) - descriptors[ends[1]].astype(np.float32)
        node = np.repeat(np.arange(len(sizes)), sizes)
        order = order[np.lexsort((_projected(descriptors, order, direction, node, starts), node))]
        starts = np.sort(np.concatenate([starts, starts[:-1] + sizes // 2]))
    return order, starts


def _projected(
    descriptors: NDArray[np.uint8],
    order: NDArray[np.int64],
    direction: NDArray[np.float32],
    node: NDArray[np.int64],
    starts: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Return the projections (M,) of the descriptors in `order` on the directions of their nodes."""
    value = np.empty(len(order), np.float32)
    for first in range(0, len(order), _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        x = descriptors[order[rows]].astype(np.float32)
        if len(direction) <= _FEW_NODES:
            for k in range(node[rows][0], node[rows][-1] + 1):
                own = slice(max(starts[k], first) - first, min(starts[k + 1], first + len(x)) - first)
                value[rows][own] = x[own] @ direction[k]
        else:
            value[rows] = np.einsum("ij,ij->i", x, direction[node[rows]])
    return value
