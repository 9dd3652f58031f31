"""Where one pair is left of several that contradict each other: those that agree with most others tie the two sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, adjoint, difference, invert, translation
from planish.registration.network.adjust import Adjusted, NetworkOptions
from planish.registration.network.loops import graph_of, side_of
from planish.registration.result import PairResult

#: Of a pair without any other way around it, only what is given from outside, far less certain, controls this much.
LITTLE_REDUNDANCY = 0.05


#: Evidence decides where false alarms are less likely by this much (log10): by as much pairs are accepted at all.
_DECISIVE = 3.0


@dataclass(frozen=True, eq=False)
class Vote:
    """What one pair says of the place of one side against the other.

    `motion` (4, 4) is that of the side from where it is now, in world; `covariance` (6, 6) that of the pair about the
    side's centre.
    """

    pair: PairResult
    motion: Array
    covariance: Array


def outvoted(
    adjusted: Adjusted, pairs: Sequence[PairResult], names: Sequence[str], options: NetworkOptions
) -> tuple[PairResult, list[PairResult]] | None:
    """Return a pair on which one side hangs though others that contradict it are as many or more, and these; or None.

    With as many on both sides the stronger evidence counts; where it does not decide, there are no others.
    """
    graph = graph_of(pairs, names)
    taken_out = [p for p in pairs if p.removed_reason is not None and p.a in graph and p.b in graph]
    for kept in pairs:
        c = adjusted.contradictions.get(("pair", kept.a, kept.b, ""))
        if not kept.used or c is None or c.redundancy > LITTLE_REDUNDANCY:
            continue
        side = set(side_of(graph, kept.a, kept.b))
        if kept.b in side:
            continue
        across = [p for p in taken_out if (p.a in side) != (p.b in side)]
        if not across:
            continue
        members = sorted(side)
        centre = np.mean([adjusted.T_world_measurement[name][:3, 3] for name in members], axis=0)
        votes = [_vote(p, side, adjusted.T_world_measurement, centre) for p in (kept, *across)]
        clubs = [[other for other in votes if _agree(one, other, centre, options)] for one in votes]
        ranked = sorted(clubs, key=lambda club: (-len(club), _evidence(club)))
        best = ranked[0]
        rival = next((club for club in ranked if all(vote not in best for vote in club)), None)
        if rival and len(rival) == len(best) and _evidence(rival) - _evidence(best) < _DECISIVE:
            return kept, []
        if all(vote.pair is not kept for vote in best):
            return kept, [vote.pair for vote in best]
    return None


def _vote(pair: PairResult, side: set[str], T_world: Mapping[str, Array], centre: Array) -> Vote:
    assert pair.T_a_b is not None
    assert pair.covariance_noise is not None
    assert pair.covariance_point_mm is not None
    T_a, T_b = T_world[pair.a], T_world[pair.b]
    # The side moves so that the pair fits exactly.
    motion = T_b @ invert(pair.T_a_b) @ invert(T_a) if pair.a in side else T_a @ pair.T_a_b @ invert(T_b)
    carry = adjoint(translation(-centre) @ T_a @ translation(pair.covariance_point_mm))
    C = pair.covariance_noise
    if pair.covariance_calibration is not None:
        C = C + pair.covariance_calibration
    return Vote(pair, motion, carry @ C @ carry.T)


def _agree(one: Vote, other: Vote, centre: Array, options: NetworkOptions) -> bool:
    if one is other:
        return True
    gap = difference(one.motion, other.motion, centre)
    sigma = float(np.sqrt(gap @ np.linalg.solve(one.covariance + other.covariance, gap) / 6))
    return float(np.linalg.norm(gap[3:])) <= options.blunder_mm or sigma <= options.blunder_sigma


def _evidence(votes: Sequence[Vote]) -> float:
    return sum(vote.pair.log10_false_alarms for vote in votes)
