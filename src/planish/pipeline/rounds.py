"""Pairs round by round: those that votes choose, then those that the network of all pairs so far shows to overlap."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from planish.pipeline.options import RegisterOptions
from planish.registration.candidates.choose import (
    Choice,
    Pair,
    next_voted_pairs,
    overlapping_pairs,
)
from planish.registration.candidates.footprint import Footprint
from planish.registration.candidates.overlaps import find_overlaps
from planish.registration.network.build import Node, build_network
from planish.registration.result import PairResult


def register_in_rounds(
    choice: Choice,
    known: Sequence[Pair],
    nodes: Sequence[Node],
    options: RegisterOptions,
    register: Callable[[Sequence[Pair]], list[PairResult]],
    footprints: Callable[[], Mapping[str, Footprint]],
    new: Collection[str] | None = None,
) -> tuple[list[Pair], list[PairResult]]:
    """Register pairs until no further ones are worth trying; return those beyond `known`, and the results of all.

    A measurement that votes have tied to one neighbour is placed, so that all it overlaps are known; what is still
    apart gets the next ones that votes suggest, once. What is tried follows from results alone, whoever computes them.

    Parameters
    ----------
    choice : Choice
    known : sequence of (str, str)
        Pairs that were tried before.
    nodes : sequence of Node
        All measurements.
    register : callable
        Registers pairs, or finds what is known of them.
    footprints : callable
        Called once, before the second round: points of all measurements by name.
    new : collection of str, optional
        Of pairs that only votes suggest, only those with one of these.
    """
    tried, results = list(choice.pairs), register([*known, *choice.pairs])
    if choice.votes is None or options.candidates.rounds == 1:
        return tried, results
    surfaces = footprints()
    for number in range(1, options.candidates.rounds):
        done = {*known, *tried}
        placed = {m.name: m for m in build_network(nodes, results, options.network).measurements}
        group = np.array([placed[name].group for name in choice.names])
        T_world = np.array([placed[name].T_world_measurement for name in choice.names])
        overlaps = find_overlaps([surfaces[name] for name in choice.names], T_world, group)
        more = overlapping_pairs(choice.names, overlaps, options.candidates) - done
        if number == 1:
            more |= next_voted_pairs(choice, group, done, options.candidates, new)
        if not more:
            break
        tried += sorted(more)
        results += register(sorted(more))
    return sorted(tried), sorted(results, key=lambda pair: (pair.a, pair.b))
