"""Which measurements' descriptors are near each other more often than chance has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.registration.candidates.forest import nearest_of_others
from planish.registration.candidates.sample import Sample

#: Neighbours that a descriptor votes for; the next one is what it would find without overlap.
_VOTED = 4
#: Votes are counted in these parts: sums of whole numbers do not depend on their order.
_PARTS = 1000


@dataclass(frozen=True)
class Votes:
    """P pairs of measurements that anything speaks for.

    Parameters
    ----------
    index_a, index_b : ndarray (P,) int64
        Indices of the measurements, a < b, sorted.
    significance : ndarray (P,)
        By how many standard deviations the votes exceed those of chance.
    """

    index_a: NDArray[np.int64]
    index_b: NDArray[np.int64]
    significance: Array


def count_votes(sample: Sample, measurements: int, trees: int) -> Votes:
    """Return the votes of all descriptors for pairs of `measurements` measurements.

    A descriptor votes for the measurements of its nearest neighbours, the more the nearer they are than the next
    nearest, which stands for what it would meet by chance (McCann and Lowe, Local naive Bayes nearest neighbor for
    image classification, CVPR 2012); here by the ratio of the distances.
    """
    voter, target, weight = (np.concatenate(parts) for parts in zip(*_cast(sample, trees), strict=True))
    square = weight**2
    total = max(float(weight.sum()), 1.0)
    given, spread, taken = (
        np.bincount(by, what, measurements) for by, what in ((voter, weight), (voter, square), (target, weight))
    )
    key, place = np.unique(np.minimum(voter, target) * measurements + np.maximum(voter, target), return_inverse=True)
    a, b = np.divmod(key, measurements)
    found = np.bincount(place, weight, len(key))
    # Votes by chance fall on a measurement as often as on average: the variance is that of a Poisson process.
    expected = (given[a] * taken[b] + given[b] * taken[a]) / total
    variance = (spread[a] * taken[b] + spread[b] * taken[a]) / total
    return Votes(a, b, (found - expected) / np.sqrt(np.maximum(variance, 1.0)))


def _cast(sample: Sample, trees: int) -> list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]]:
    """Return voter, target and weight of the votes, per size and rank of the neighbours."""
    none = np.empty(0, np.int64)
    votes = [(none, none, none)]
    for size in np.unique(sample.size_mm):
        own = sample.size_mm == size
        owner = sample.owner[own].astype(np.int64)
        squared, index = nearest_of_others(sample.descriptors[own], sample.owner[own], _VOTED + 1, trees)
        target = np.where(index >= 0, owner[index], -1)
        # Where fewer are found, the last of them is the measure.
        chance = np.sqrt(np.maximum(squared.max(axis=1), 1))
        for rank in range(_VOTED):
            again = (target[:, :rank] == target[:, rank : rank + 1]).any(axis=1)
            voting = (target[:, rank] >= 0) & ~again
            weight = np.rint(_PARTS * (1 - np.sqrt(squared[voting, rank]) / chance[voting])).astype(np.int64)
            votes.append((owner[voting], target[voting, rank], weight))
    return votes
