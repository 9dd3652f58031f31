"""A part of each measurement's descriptors, all of them in one array: what pairs are chosen from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.registration.keypoints.keypoints import Keypoints


@dataclass(frozen=True)
class Sample:
    """M descriptors of all measurements of a run.

    Parameters
    ----------
    descriptors : ndarray (M, 128) uint8
    owner : ndarray (M,) int32
        Index of the measurement that each belongs to.
    size_mm : ndarray (M,)
        Diameter of the blob [mm]; those of different sizes are not compared.
    """

    descriptors: NDArray[np.uint8]
    owner: NDArray[np.int32]
    size_mm: Array


def take_sample(keypoints: Mapping[str, Keypoints], names: Sequence[str], count: int) -> Sample:
    """Return at most `count` descriptors of each measurement in the order of `names`, which are read one at a time."""
    descriptors, owner, size_mm = [np.empty((0, 128), np.uint8)], [np.empty(0, np.int32)], [np.empty(0)]
    for number, name in enumerate(names):
        item = keypoints[name]
        chosen = _surest(item, count)
        descriptors.append(item.descriptors[chosen])
        owner.append(np.full(len(chosen), number, np.int32))
        size_mm.append(item.size_mm[chosen])
    return Sample(np.concatenate(descriptors), np.concatenate(owner), np.concatenate(size_mm))


def _surest(item: Keypoints, count: int) -> NDArray[np.intp]:
    """Indices of the surest keypoints: the same share of every chart and size, whose own come in this order."""
    groups = np.stack([item.chart.astype(float), item.size_mm])
    _, group, sizes = np.unique(groups, axis=1, return_inverse=True, return_counts=True)
    order = np.argsort(group.ravel(), kind="stable")
    rank = np.empty(len(item))
    rank[order] = np.arange(len(item)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    share = (rank + 0.5) / sizes[group.ravel()]
    return np.sort(np.argsort(share, kind="stable")[:count])
