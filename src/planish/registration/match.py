"""Matches: mutual nearest neighbours of the descriptors, among keypoints of the same metric size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.options import Options
from planish.registration.keypoints import Keypoints


class MatchOptions(Options):
    """Options of the matching."""

    #: Nearest over second nearest descriptor distance; grain needs more freedom than the usual 0.8.
    max_ratio: float = Field(default=0.95, gt=0, le=1)
    #: The texture has one metric scale: sizes of two matching keypoints agree within this factor.
    max_size_ratio: float = Field(default=1.4, ge=1)
    #: Most matches that go on, best ratio first.
    max_matches: int = Field(default=2500, ge=10)


@dataclass(frozen=True)
class Matches:
    """M pairs of keypoints.

    Parameters
    ----------
    index_a, index_b : ndarray (M,) int64
        Indices into the two Keypoints; each index stands at most once.
    ratio : ndarray (M,)
        Nearest over second nearest descriptor distance.
    """

    index_a: NDArray[np.int64]
    index_b: NDArray[np.int64]
    ratio: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.index_a)

    def take(self, index: NDArray[Any]) -> Matches:
        """Return the matches at `index` (indices or mask)."""
        return Matches(self.index_a[index], self.index_b[index], self.ratio[index])


def match(a: Keypoints, b: Keypoints, options: MatchOptions | None = None) -> Matches:
    """Return the mutual nearest neighbours of two keypoint sets, best ratio first."""
    options = options or MatchOptions()
    none = np.empty(0, np.int64)
    if len(a) < 2 or len(b) < 2:
        return Matches(none, none, np.empty(0))
    squared = _squared_distances(a.descriptors, b.descriptors)
    # Beyond the ratio of sizes a pair cannot be the same place; it must not serve as second nearest either.
    log_size_a, log_size_b = np.log(a.size_mm).astype(np.float32), np.log(b.size_mm).astype(np.float32)
    other_size = np.abs(log_size_a[:, None] - log_size_b[None]) > np.log(options.max_size_ratio)
    squared[other_size] = np.inf
    rows = np.arange(len(a))
    best = np.argmin(squared, axis=1)
    nearest = squared[rows, best]
    mutual = np.isfinite(nearest) & (np.argmin(squared, axis=0)[best] == rows)
    squared[rows, best] = np.inf
    second = squared.min(axis=1)
    ratio = np.sqrt(nearest.astype(float) / np.maximum(second.astype(float), 1.0))
    index_a = np.flatnonzero(mutual & (ratio <= options.max_ratio))
    order = np.lexsort((index_a, ratio[index_a]))[: options.max_matches]
    index_a = index_a[order]
    return Matches(index_a, best[index_a].astype(np.int64), ratio[index_a])


def _squared_distances(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.float32]:
    # |a - b|^2 = |a|^2 + |b|^2 - 2 a.b; all are whole numbers below 2^24 and so exact in float32.
    x, y = a.astype(np.float32), b.astype(np.float32)
    return (x**2).sum(1)[:, None] + (y**2).sum(1)[None] - 2 * (x @ y.T)
