"""Which pairs of measurements are tried: all of few; of many those whose descriptors speak for it, then those that the
network of these shows to overlap.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.geometry import Array
from planish.options import Options
from planish.registration.candidates.overlaps import Overlaps
from planish.registration.candidates.sample import take_sample
from planish.registration.candidates.votes import Votes, count_votes
from planish.registration.keypoints.keypoints import Keypoints


class CandidateOptions(Options):
    """Options of the choice of pairs."""

    #: Runs of up to so many measurements try all pairs: some four times as many as rounds would choose, none is lost.
    exhaustive_up_to: int = Field(default=40, ge=1)
    #: Most descriptors that are compared per measurement, the surest of each chart and scale.
    descriptors: int = Field(default=5000, ge=10)
    #: Random trees that neighbours are sought in.
    trees: int = Field(default=4, ge=1)
    #: Partners that each measurement is tried with, those with the most significant votes first, whatever these say.
    #: One that is right places a measurement: what else it overlaps is seen then.
    partners: int = Field(default=6, ge=1)
    #: Most partners whose votes are significant that each measurement is tried with.
    most_partners: int = Field(default=24, ge=1)
    #: Votes that exceed chance by so many standard deviations are significant.
    min_significance: float = Field(default=5.0, gt=0)
    #: Rounds at most: in the first one votes choose, in each further one the network of all pairs so far.
    rounds: int = Field(default=3, ge=1)
    #: Share of the smaller surface that two measurements must have in common, as placed by the network, to be tried.
    min_overlap: float = Field(default=0.1, gt=0, lt=1)


Pair = tuple[str, str]


@dataclass(frozen=True)
class Choice:
    """What is tried in the first round, and what later rounds go by.

    Parameters
    ----------
    names : list of str
        All measurements, sorted.
    pairs : list of (str, str)
        The first round's, a < b, sorted.
    votes : Votes or None
        By the index in `names`; None where all pairs are tried at once.
    """

    names: list[str]
    pairs: list[Pair]
    votes: Votes | None


def choose_pairs(
    keypoints: Mapping[str, Keypoints], options: CandidateOptions | None = None, new: Collection[str] | None = None
) -> Choice:
    """Return the pairs (a, b) of names, a < b, that are worth trying first.

    Parameters
    ----------
    keypoints : mapping of Keypoints
        By the name of the measurement; may read each from its file when it is asked for.
    options : CandidateOptions, optional
    new : collection of str, optional
        Only pairs with one of these: the others have been tried.
    """
    options, names, votes = options or CandidateOptions(), sorted(keypoints), None
    if len(names) <= options.exhaustive_up_to:
        pairs = list(combinations(names, 2))
    else:
        votes = count_votes(take_sample(keypoints, names, options.descriptors), len(names), options.trees)
        pairs = [(names[a], names[b]) for a, b in best_partners(votes, options)]
    return Choice(names, [pair for pair in pairs if new is None or pair[0] in new or pair[1] in new], votes)


def goes_in_rounds(measurements: int, options: CandidateOptions) -> bool:
    """Return whether so many measurements are tried round by round, not all pairs at once."""
    return measurements > options.exhaustive_up_to and options.rounds > 1


def best_partners(votes: Votes, options: CandidateOptions) -> NDArray[np.int64]:
    """Return the pairs (P, 2) of indices that are among the best ones of either of their measurements, sorted."""
    one, other, rank, value = _ranks(votes.index_a, votes.index_b, votes.significance)
    kept = (rank < options.partners) | ((rank < options.most_partners) & (value >= options.min_significance))
    pairs = np.column_stack([np.minimum(one, other), np.maximum(one, other)])[kept]
    return np.unique(pairs, axis=0)


def _ranks(
    a: NDArray[np.int64], b: NDArray[np.int64], value: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]:
    """Return each pair from both sides: one, the other, its rank among all pairs of the one, best first, its value."""
    one, other, value = np.concatenate([a, b]), np.concatenate([b, a]), np.concatenate([value, value])
    order = np.lexsort((other, -value, one))
    one, other, value = one[order], other[order], value[order]
    return one, other, np.arange(len(one)) - np.searchsorted(one, one), value


def overlapping_pairs(names: list[str], overlaps: Overlaps, options: CandidateOptions) -> set[Pair]:
    """Return the pairs that share enough of their surfaces, of each measurement those with its largest overlaps.

    Ranks count among all overlaps, tried or not: a place that any number of measurements sees ties each to as many as
    votes could.
    """
    enough = overlaps.share >= options.min_overlap
    a, b, share = overlaps.index_a[enough], overlaps.index_b[enough], overlaps.share[enough]
    one, other, rank, _ = _ranks(a, b, share)
    kept = rank < options.most_partners
    return {(names[min(i, j)], names[max(i, j)]) for i, j in zip(one[kept].tolist(), other[kept].tolist(), strict=True)}


def next_voted_pairs(
    choice: Choice,
    group: NDArray[np.int64],
    tried: Collection[Pair],
    options: CandidateOptions,
    new: Collection[str] | None = None,
) -> set[Pair]:
    """Return, for each group but group 0, the largest, the best untried pairs that votes suggest out of it.

    As many of a whole group as a single measurement is tried with in the first round: two parts that have nothing in
    common cost no more for being large.
    """
    assert choice.votes is not None
    a, b, significance = choice.votes.index_a, choice.votes.index_b, choice.votes.significance
    done, names = set(tried), choice.names
    apart = np.flatnonzero(group[a] != group[b])
    apart = apart[np.lexsort((b[apart], a[apart], -significance[apart]))]
    left = dict.fromkeys(np.unique(group[group > 0]).tolist(), options.partners)
    chosen: set[Pair] = set()
    for k in apart.tolist():
        if not any(left.values()):
            break
        pair = names[a[k]], names[b[k]]
        if pair in done or not (new is None or pair[0] in new or pair[1] in new):
            continue
        groups = [g for g in (int(group[a[k]]), int(group[b[k]])) if left.get(g)]
        for g in groups:
            left[g] -= 1
        if groups:
            chosen.add(pair)
    return chosen


def possible_pairs(measurements: int) -> int:
    """Return how many pairs so many measurements have: what the chance of false alarms in a run is counted with.

    Pairs are chosen by looking at the data of all, and by what makes false alarms, too: texture that looks alike. That
    a pair is wrongly accepted is no likelier because others were not tried, but the number tried would hide how many
    were looked at; the number of all bounds the expected false alarms for any choice (union bound).
    """
    return measurements * (measurements - 1) // 2
