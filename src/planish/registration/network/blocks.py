"""Symmetric positive definite equations of 6 x 6 blocks, sparse: factor, solution, chosen blocks of the inverse.

Six unknowns per measurement, one block per pair: a network of n measurements has few of the n^2 blocks. Multifrontal
Cholesky (Duff and Reid 1983), one front per supernode; the inverse where N has blocks by the recursion of Takahashi,
Fagan and Chin (1973), which never builds the rest of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from planish.geometry import Array
from planish.registration.network.elimination import Elimination, Indices, eliminate, supernodes

#: Unknowns of one block.
SIZE = 6


@dataclass(frozen=True)
class BlockCholesky:
    """P D N D P' = L L' with D making N's diagonal one, for rotations and translations differ by orders of magnitude.

    Parameters
    ----------
    pattern : Elimination
        Order of the unknowns, and where L has its r blocks below the diagonal.
    diagonal : ndarray (n, 6, 6)
        Blocks of L on the diagonal, lower triangles.
    columns : ndarray (r, 6, 6)
        Blocks of L below the diagonal, in the order of `pattern.below`.
    scale : ndarray (n, 6)
        The diagonal of D, in the order of the unknowns.
    """

    pattern: Elimination
    diagonal: Array
    columns: Array
    scale: Array

    def solve(self, rhs: Array) -> Array:
        """Return N^-1 rhs for rhs (n, 6, m)."""
        x = (rhs * self.scale[:, :, None])[self.pattern.order]
        width = x.shape[2]
        if not x.size:
            return x
        fronts = list(self._fronts())
        for first, end, rows, own, across in fronts:
            here = solve_triangular(own, x[first:end].reshape(-1, width), lower=True, check_finite=False)
            x[first:end] = here.reshape(-1, SIZE, width)
            x[rows] -= (across @ here).reshape(-1, SIZE, width)
        for first, end, rows, own, across in reversed(fronts):
            here = x[first:end].reshape(-1, width) - across.T @ x[rows].reshape(-1, width)
            here = solve_triangular(own, here, lower=True, trans=1, check_finite=False)
            x[first:end] = here.reshape(-1, SIZE, width)
        out = np.empty_like(x)
        out[self.pattern.order] = x
        return out * self.scale[:, :, None]

    def inverse_blocks(self, i: Indices, j: Indices) -> Array:
        """Return the blocks (m, 6, 6) of N^-1 at (i, j); N itself must have blocks there."""
        rank = self.pattern.rank
        upper, lower = np.minimum(rank[i], rank[j]), np.maximum(rank[i], rank[j])
        wanted = np.argsort(upper, kind="stable")
        out = np.empty((len(i), SIZE, SIZE))
        for first, end, rows, Z in self._inverse_fronts():
            part = wanted[slice(*np.searchsorted(upper[wanted], [first, end]))]
            if len(part):
                members = np.r_[first:end, rows]
                blocks = Z.reshape(len(members), SIZE, len(members), SIZE)
                out[part] = blocks[np.searchsorted(members, lower[part]), :, upper[part] - first, :]
        swapped = rank[i] < rank[j]
        out[swapped] = np.swapaxes(out[swapped], 1, 2)
        return out * self.scale[i][:, :, None] * self.scale[j][:, None, :]

    def _fronts(self) -> Iterator[tuple[int, int, Indices, Array, Array]]:
        """Yield per supernode its first column and their end, the rows below, and L's blocks of both, dense."""
        begins = supernodes(self.pattern.starts, self.pattern.below)
        for first, end in zip(begins[:-1].tolist(), begins[1:].tolist(), strict=True):
            rows = self.pattern.below[self.pattern.starts[end - 1] : self.pattern.starts[end]]
            dense = np.zeros((end - first + len(rows), SIZE, end - first, SIZE))
            for k in range(first, end):
                dense[k - first, :, k - first] = self.diagonal[k]
                dense[k - first + 1 :, :, k - first] = self.columns[self.pattern.starts[k] : self.pattern.starts[k + 1]]
            L = dense.reshape(-1, SIZE * (end - first))
            yield first, end, rows, L[: L.shape[1]], L[L.shape[1] :]

    def _inverse_fronts(self) -> Iterator[tuple[int, int, Indices, Array]]:
        """Yield per supernode, last first, its columns, the rows below, and the scaled inverse at both."""
        fronts = list(self._fronts())
        parents = [int(rows[0]) if len(rows) else -1 for _, _, rows, _, _ in fronts]
        begins = [first for first, *_ in fronts]
        above = [int(np.searchsorted(begins, parent, side="right")) - 1 for parent in parents]
        children = np.bincount([a for a in above if a >= 0], minlength=len(fronts))
        kept: dict[int, tuple[Indices, Array]] = {}
        for number in range(len(fronts) - 1, -1, -1):
            first, end, rows, own, across = fronts[number]
            root = solve_triangular(own, np.eye(len(own)), lower=True, check_finite=False)
            Z = np.empty((len(own) + len(across),) * 2)
            cut = len(own)
            Z[:cut, :cut] = root.T @ root
            if len(rows):
                members, beside = kept[above[number]]
                at = scalars(np.searchsorted(members, rows))
                Z[cut:, cut:] = beside[np.ix_(at, at)]
                W = across @ root
                Z[cut:, :cut] = -Z[cut:, cut:] @ W
                Z[:cut, cut:] = Z[cut:, :cut].T
                Z[:cut, :cut] -= W.T @ Z[cut:, :cut]
                children[above[number]] -= 1
                if not children[above[number]]:
                    del kept[above[number]]
            if children[number]:
                kept[number] = np.r_[first:end, rows], Z
            yield first, end, rows, Z


def factor(n: int, i: Indices, j: Indices, blocks: Array, pattern: Elimination | None = None) -> BlockCholesky:
    """Return the factor of N, n blocks square: the sum of `blocks` (m, 6, 6) at (i, j), and transposed at (j, i).

    `pattern` is what `eliminate` says of the same n, i and j, if that is known.

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
    pattern = pattern or eliminate(n, i[~same], j[~same])
    scaled = (blocks * scale[i][:, :, None] * scale[j][:, None, :])[~same]
    a, b = pattern.rank[i[~same]], pattern.rank[j[~same]]
    scaled[a < b] = np.swapaxes(scaled[a < b], 1, 2)
    # Several relations may tie the same two.
    place, number = np.unique(np.minimum(a, b) * n + np.maximum(a, b), return_inverse=True)
    beside = np.zeros((len(place), SIZE, SIZE))
    np.add.at(beside, number, scaled)
    upper, lower = np.divmod(place, n)
    diagonal *= scale[:, :, None] * scale[:, None, :]
    roots, columns = _factor_fronts(diagonal[pattern.order], pattern, upper, lower, beside)
    return BlockCholesky(pattern, roots, columns, scale)


def _factor_fronts(
    diagonal: Array, pattern: Elimination, upper: Indices, lower: Indices, blocks: Array
) -> tuple[Array, Array]:
    """Return L's blocks on the diagonal and below it; `blocks` stand in rows `lower` of columns `upper`, rising."""
    roots, columns = np.empty_like(diagonal), np.empty((len(pattern.below), SIZE, SIZE))
    begins = supernodes(pattern.starts, pattern.below)
    updates: dict[int, list[tuple[Indices, Array]]] = {}
    for first, end in zip(begins[:-1].tolist(), begins[1:].tolist(), strict=True):
        rows = pattern.below[pattern.starts[end - 1] : pattern.starts[end]]
        members, own = np.r_[first:end, rows], np.arange(end - first)
        front = np.zeros((len(members), SIZE, len(members), SIZE))
        front[own, :, own] = diagonal[first:end]
        part = slice(*np.searchsorted(upper, [first, end]))
        front[np.searchsorted(members, lower[part]), :, upper[part] - first] = blocks[part]
        F = front.reshape(SIZE * len(members), -1)
        for their_rows, U in updates.pop(first, ()):
            at = scalars(np.searchsorted(members, their_rows))
            F[np.ix_(at, at)] += U
        cut = SIZE * len(own)
        L = F[:, :cut]
        L[:cut] = np.linalg.cholesky(L[:cut])
        L[cut:] = solve_triangular(L[:cut], L[cut:].T, lower=True, check_finite=False).T
        if len(rows):
            above = int(begins[np.searchsorted(begins, rows[0], side="right") - 1])
            updates.setdefault(above, []).append((rows, F[cut:, cut:] - L[cut:] @ L[cut:].T))
        done = L.reshape(len(members), SIZE, len(own), SIZE)
        for k in range(first, end):
            roots[k] = done[k - first, :, k - first]
            columns[pattern.starts[k] : pattern.starts[k + 1]] = done[k - first + 1 :, :, k - first]
    return roots, columns


def scalars(blocks: Indices) -> Indices:
    """Return the numbers of the scalar unknowns of blocks."""
    return np.asarray((SIZE * blocks[:, None] + np.arange(SIZE)).ravel(), np.int64)
