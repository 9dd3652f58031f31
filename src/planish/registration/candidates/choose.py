"""Which pairs of measurements are tried: all of few, of many those whose descriptors speak for it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.options import Options
from planish.registration.candidates.sample import take_sample
from planish.registration.candidates.votes import Votes, count_votes
from planish.registration.keypoints.keypoints import Keypoints


class CandidateOptions(Options):
    """Options of the choice of pairs."""

    #: Runs of up to so many measurements try all pairs: some twice as many as votes would choose, and none is lost.
    exhaustive_up_to: int = Field(default=40, ge=1)
    #: Most descriptors that are compared per measurement, the surest of each chart and scale.
    descriptors: int = Field(default=5000, ge=10)
    #: Random trees that neighbours are sought in.
    trees: int = Field(default=4, ge=1)
    #: Partners that each measurement is tried with, those with the most significant votes first, whatever these say.
    partners: int = Field(default=12, ge=1)
    #: Most partners whose votes are significant that each measurement is tried with.
    most_partners: int = Field(default=24, ge=1)
    #: Votes that exceed chance by so many standard deviations are significant.
    min_significance: float = Field(default=5.0, gt=0)


def candidate_pairs(
    keypoints: Mapping[str, Keypoints], options: CandidateOptions | None = None, new: Collection[str] | None = None
) -> list[tuple[str, str]]:
    """Return the pairs (a, b) of names, a < b, that are worth trying, sorted.

    Parameters
    ----------
    keypoints : mapping of Keypoints
        By the name of the measurement; may read each from its file when it is asked for.
    options : CandidateOptions, optional
    new : collection of str, optional
        Only pairs with one of these: the others have been tried.
    """
    options, names = options or CandidateOptions(), sorted(keypoints)
    if len(names) <= options.exhaustive_up_to:
        pairs = list(combinations(names, 2))
    else:
        votes = count_votes(take_sample(keypoints, names, options.descriptors), len(names), options.trees)
        pairs = [(names[a], names[b]) for a, b in best_partners(votes, options)]
    return [pair for pair in pairs if new is None or pair[0] in new or pair[1] in new]


def best_partners(votes: Votes, options: CandidateOptions) -> NDArray[np.int64]:
    """Return the pairs (P, 2) of indices that are among the best ones of either of their measurements, sorted."""
    one, other = np.concatenate([votes.index_a, votes.index_b]), np.concatenate([votes.index_b, votes.index_a])
    significance = np.concatenate([votes.significance, votes.significance])
    order = np.lexsort((other, -significance, one))
    one, other, significance = one[order], other[order], significance[order]
    rank = np.arange(len(one)) - np.searchsorted(one, one)
    kept = (rank < options.partners) | ((rank < options.most_partners) & (significance >= options.min_significance))
    pairs = np.column_stack([np.minimum(one, other), np.maximum(one, other)])[kept]
    return np.unique(pairs, axis=0)


def possible_pairs(measurements: int) -> int:
    """Return how many pairs so many measurements have: what the chance of false alarms in a run is counted with.

    Pairs are chosen by looking at the data of all, and by what makes false alarms, too: texture that looks alike. That
    a pair is wrongly accepted is no likelier because others were not tried, but the number tried would hide how many
    were looked at; the number of all bounds the expected false alarms for any choice (union bound).
    """
    return measurements * (measurements - 1) // 2
