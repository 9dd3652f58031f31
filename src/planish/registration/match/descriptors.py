"""Pairs of keypoints whose descriptors are near each other, as candidates for the comparison of their patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.registration.keypoints.keypoints import Keypoints


@dataclass(frozen=True)
class Neighbours:
    """M pairs of keypoints of which one is the other's nearest by descriptor, best first.

    Parameters
    ----------
    index_a, index_b : ndarray (M,) int64
        Indices into the two Keypoints; no pair stands twice.
    ratio : ndarray (M,)
        Nearest over second nearest descriptor distance, the lesser of both directions.
    mutual : ndarray (M,) bool
        Whether each is the other's nearest.
    """

    index_a: NDArray[np.int64]
    index_b: NDArray[np.int64]
    ratio: NDArray[np.float64]
    mutual: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.index_a)


def nearest_neighbours(a: Keypoints, b: Keypoints, max_size_ratio: float, count: int, threads: int) -> Neighbours:
    """Return the `count` best pairs of nearest neighbours of either direction: mutual ones first, then by ratio."""
    forward, backward = _core.nearest_descriptors(
        a.descriptors, a.size_mm, b.descriptors, b.size_mm, max_size_ratio, threads
    )
    from_a, from_b = np.flatnonzero(forward[:, 0] >= 0), np.flatnonzero(backward[:, 0] >= 0)
    index_a = np.concatenate([from_a, backward[from_b, 0]]).astype(np.int64)
    index_b = np.concatenate([forward[from_a, 0], from_b]).astype(np.int64)
    ratio = np.concatenate([_ratio(forward[from_a]), _ratio(backward[from_b])])
    # A pair that stands twice is mutual.
    pair, back, times = np.unique(index_a * len(b) + index_b, return_inverse=True, return_counts=True)
    least = np.full(len(pair), np.inf)
    np.minimum.at(least, back, ratio)
    order = np.lexsort((pair, least, times == 1))[:count]
    index_a, index_b = np.divmod(pair[order], max(len(b), 1))
    return Neighbours(index_a, index_b, least[order], times[order] == 2)


def _ratio(found: NDArray[np.int32]) -> NDArray[np.float64]:
    """Nearest over second nearest distance; 1 where both are zero."""
    nearest, second = found[:, 1].astype(float), found[:, 2].astype(float)
    return np.sqrt(np.divide(nearest, second, out=np.ones(len(found)), where=second > 0))
