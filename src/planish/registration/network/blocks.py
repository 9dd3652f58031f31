"""Symmetric positive definite equations of 6 x 6 blocks, sparse: factor, solution, chosen blocks of the inverse.

Six unknowns per measurement, one block per pair: a network of n measurements has few of the n^2 blocks. Multifrontal
Cholesky (Duff and Reid 1983) after minimum degree (Tinney and Walker 1967); the inverse where N has blocks by the
recursion of Takahashi, Fagan and Chin (1973), which never builds the rest of it.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array

Indices = NDArray[np.int64]
#: Unknowns of one block.
SIZE = 6


@dataclass(frozen=True)
class BlockCholesky:
    """P D N D P' = L L' with D making N's diagonal one, for rotations and translations differ by orders of magnitude.

    Parameters
    ----------
    order : ndarray (n,) of int
        order[k] is the unknown that is eliminated as the k-th.
    starts, below : ndarray (n + 1,), (r,) of int
        below[starts[k]:starts[k + 1]] are the rows > k of column k's blocks below the diagonal, rising.
    diagonal : ndarray (n, 6, 6)
        Blocks of L on the diagonal, lower triangles.
    columns : ndarray (r, 6, 6)
        Blocks of L below the diagonal, in the order of `below`.
    scale : ndarray (n, 6)
        The diagonal of D, in the order of the unknowns.
    """

    order: Indices
    starts: Indices
    below: Indices
    diagonal: Array
    columns: Array
    scale: Array

    def column(self, k: int) -> tuple[Indices, Array]:
        """Return the rows (r,) of column k below the diagonal and its blocks (6 r, 6), one under the other."""
        part = slice(self.starts[k], self.starts[k + 1])
        return self.below[part], self.columns[part].reshape(-1, SIZE)

    def solve(self, rhs: Array) -> Array:
        """Return N^-1 rhs for rhs (n, 6, m)."""
        x = (rhs * self.scale[:, :, None])[self.order]
        for k in range(len(self.order)):
            rows, column = self.column(k)
            x[k] = np.linalg.solve(self.diagonal[k], x[k])
            if len(rows):
                x[rows] -= (column @ x[k]).reshape(len(rows), SIZE, -1)
        for k in range(len(self.order) - 1, -1, -1):
            rows, column = self.column(k)
            if len(rows):
                x[k] -= column.T @ x[rows].reshape(len(rows) * SIZE, -1)
            x[k] = np.linalg.solve(self.diagonal[k].T, x[k])
        out = np.empty_like(x)
        out[self.order] = x
        return out * self.scale[:, :, None]

    def inverse_blocks(self, i: Indices, j: Indices) -> Array:
        """Return the blocks (m, 6, 6) of N^-1 at (i, j); N itself must have blocks there."""
        rank = np.empty(len(self.order), np.int64)
        rank[self.order] = np.arange(len(self.order))
        wanted: dict[int, list[int]] = {}
        for m, (a, b) in enumerate(zip(rank[i], rank[j], strict=True)):
            wanted.setdefault(int(min(a, b)), []).append(m)
        out = np.empty((len(i), SIZE, SIZE))
        for k, rows, Z in self._inverse_fronts():
            for m in wanted.get(k, ()):
                a, b = int(rank[i[m]]), int(rank[j[m]])
                at = 0 if a == b else 1 + int(np.searchsorted(rows, max(a, b)))
                block = Z[at * SIZE : (at + 1) * SIZE, :SIZE]
                out[m] = block.T if a < b else block
        return out * self.scale[i][:, :, None] * self.scale[j][:, None, :]

    def _inverse_fronts(self) -> Iterator[tuple[int, Indices, Array]]:
        """Yield k, rows below it and the scaled inverse (6 (1 + r), 6 (1 + r)) at k and these rows, last k first."""
        n = len(self.order)
        inner = self.starts[:-1] < self.starts[1:]
        children = np.bincount(self.below[self.starts[:-1][inner]], minlength=n)
        fronts: dict[int, Array] = {}
        for k in range(n - 1, -1, -1):
            (rows, column), root = self.column(k), np.linalg.inv(self.diagonal[k])
            Z = np.empty((SIZE * (1 + len(rows)),) * 2)
            Z[:SIZE, :SIZE] = root.T @ root
            if len(rows):
                parent = int(rows[0])
                at = _scalars(np.searchsorted(np.r_[parent, self.column(parent)[0]], rows))
                beside = fronts[parent][np.ix_(at, at)]
                W = column @ root
                across = -beside @ W
                Z[:SIZE, :SIZE] -= W.T @ across
                Z[SIZE:, :SIZE], Z[:SIZE, SIZE:], Z[SIZE:, SIZE:] = across, across.T, beside
                children[parent] -= 1
                if not children[parent]:
                    del fronts[parent]
            if children[k]:
                fronts[k] = Z
            yield k, rows, Z


def factor(n: int, i: Indices, j: Indices, blocks: Array) -> BlockCholesky:
    """Return the factor of N, n blocks square: the sum of `blocks` (m, 6, 6) at (i, j), and transposed at (j, i).

    Raises
    ------
    numpy.linalg.LinAlgError
        Where N is not positive definite: something is held by nothing.
    """
    diagonal = np.zeros((n, SIZE, SIZE))
    same = i == j
    np.add.at(diagonal, i[same], blocks[same])
    sizes = diagonal[:, range(SIZE), range(SIZE)]
    if not (sizes > 0).all():
        raise np.linalg.LinAlgError("an unknown is held by nothing")
    scale = 1 / np.sqrt(sizes)
    order, below = _eliminate(n, i[~same], j[~same])
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    scaled = blocks * scale[i][:, :, None] * scale[j][:, None, :]
    beside: list[list[tuple[int, Array]]] = [[] for _ in range(n)]
    for a, b, block in zip(rank[i[~same]], rank[j[~same]], scaled[~same], strict=True):
        beside[min(a, b)].append((int(max(a, b)), block if a > b else block.T))
    diagonal *= scale[:, :, None] * scale[:, None, :]
    roots, columns = _factor_fronts(diagonal[order], below, beside)
    starts = np.concatenate([[0], np.cumsum([len(rows) for rows in below])]).astype(np.int64)
    rows = np.concatenate([np.empty(0, np.int64), *below])
    return BlockCholesky(order, starts, rows, roots, np.concatenate(columns).reshape(-1, SIZE, SIZE), scale)


def _factor_fronts(
    diagonal: Array, below: tuple[Indices, ...], beside: Sequence[Sequence[tuple[int, Array]]]
) -> tuple[Array, tuple[Array, ...]]:
    roots, columns = np.empty_like(diagonal), []
    updates: dict[int, list[tuple[Indices, Array]]] = {}
    for k, rows in enumerate(below):
        here = np.r_[k, rows]
        F = np.zeros((SIZE * len(here),) * 2)
        F[:SIZE, :SIZE] = diagonal[k]
        for row, block in beside[k]:
            at = SIZE * (1 + int(np.searchsorted(rows, row)))
            F[at : at + SIZE, :SIZE] += block
        for their_rows, U in updates.pop(k, ()):
            inside = _scalars(np.searchsorted(here, their_rows))
            F[np.ix_(inside, inside)] += U
        roots[k] = np.linalg.cholesky(F[:SIZE, :SIZE])
        column = np.linalg.solve(roots[k], F[SIZE:, :SIZE].T).T
        columns.append(column)
        if len(rows):
            updates.setdefault(int(rows[0]), []).append((rows, F[SIZE:, SIZE:] - column @ column.T))
    return roots, tuple(columns)


def _scalars(blocks: Indices) -> Indices:
    return np.asarray((SIZE * blocks[:, None] + np.arange(SIZE)).ravel(), np.int64)


def _eliminate(n: int, i: Indices, j: Indices) -> tuple[Indices, tuple[Indices, ...]]:
    """Return the order of least degree (ties: the first unknown) and, per column of L, its rows in that order."""
    beside: list[set[int]] = [set() for _ in range(n)]
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        beside[a].add(b)
        beside[b].add(a)
    queue = [(len(item), v) for v, item in enumerate(beside)]
    heapq.heapify(queue)
    order: list[int] = []
    reached: list[list[int]] = []
    rank = np.full(n, -1, np.int64)
    while queue:
        degree, v = heapq.heappop(queue)
        if rank[v] >= 0 or degree != len(beside[v]):
            continue
        rank[v] = len(order)
        order.append(v)
        reached.append(sorted(beside[v]))
        for u in beside[v]:
            beside[u] |= beside[v]
            beside[u] -= {u, v}
            heapq.heappush(queue, (len(beside[u]), u))
    below = tuple(np.sort(rank[np.asarray(rows, np.int64)]) for rows in reached)
    return np.asarray(order, np.int64), below
