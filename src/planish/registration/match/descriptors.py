"""Mutual nearest neighbours of the descriptors, among keypoints of the same metric size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish import _core
from planish.options import Options, thread_count
from planish.registration.keypoints.keypoints import Keypoints
from planish.registration.matches import Matches


class MatchOptions(Options):
    """Options of the matching."""

    #: Nearest over second nearest descriptor distance; grain needs more freedom than the usual 0.8.
    max_ratio: float = Field(default=0.95, gt=0, le=1)
    #: The texture has one metric scale: sizes of two matching keypoints agree within this factor.
    max_size_ratio: float = Field(default=1.4, ge=1)
    #: Most matches that go on, best ratio first.
    max_matches: int = Field(default=2500, ge=10)


@dataclass(frozen=True)
class Neighbours:
    """M pairs of keypoints whose descriptors are each other's nearest, best ratio first.

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


def match(a: Keypoints, b: Keypoints, options: MatchOptions | None = None, threads: int | None = None) -> Matches:
    """Return the matches of two keypoint sets, best ratio of descriptor distances first."""
    found = nearest_neighbours(a, b, options, threads)
    a, b = a.take(found.index_a), b.take(found.index_b)
    return Matches(
        a.points_sensor, b.points_sensor, a.frames_sensor, b.frames_sensor, a.pixels, b.pixels,
        np.full(len(a), np.nan),
    )  # fmt: skip


def nearest_neighbours(
    a: Keypoints, b: Keypoints, options: MatchOptions | None = None, threads: int | None = None
) -> Neighbours:
    """Return the mutual nearest neighbours of two keypoint sets, best ratio first."""
    options, count = options or MatchOptions(), thread_count(threads)
    none = np.empty(0, np.int64)
    if len(a) < 2 or len(b) < 2:
        return Neighbours(none, none, np.empty(0))

    def nearest(x: Keypoints, y: Keypoints) -> NDArray[np.int32]:
        return _core.nearest_descriptors(
            x.descriptors, x.size_mm, y.descriptors, y.size_mm, options.max_size_ratio, count
        )

    forward, backward = nearest(a, b), nearest(b, a)
    best = forward[:, 0].astype(np.int64)
    mutual = (best >= 0) & (backward[best, 0] == np.arange(len(a)))
    ratio = np.sqrt(forward[:, 1] / np.maximum(forward[:, 2].astype(float), 1.0))
    index_a = np.flatnonzero(mutual & (ratio <= options.max_ratio))
    order = np.lexsort((index_a, ratio[index_a]))[: options.max_matches]
    index_a = index_a[order]
    return Neighbours(index_a, best[index_a], ratio[index_a])
