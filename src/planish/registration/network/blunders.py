"""Wrong pairs and wrong inputs out of a network: the worst first, several far apart at once.

Data snooping (Baarda 1968), repeated. A wrong relation makes its neighbours contradict the others too, so that of those
near each other only the worst goes at a time, and what went for another's fault comes back in the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from planish.geometry import Array, difference
from planish.registration.network.adjust import Adjusted, NetworkOptions, adjust
from planish.registration.network.contradictions import Contradiction
from planish.registration.network.groups import find_groups, start_transforms
from planish.registration.network.joint import JointCovariance
from planish.registration.network.relations import GIVEN_FRAME, ROBOT_FRAME, Relation, fixes_given_frame
from planish.registration.network.votes import outvoted
from planish.registration.result import PairResult

#: Contradictions that differ by less than this share of them are equal: second order, covariances known roughly.
_EQUAL = 0.02
Key = tuple[str, str, str, str]


@dataclass(frozen=True)
class Consistent:
    """A group without contradictions.

    `pairs` are all that were given, those taken out with `used` false; `refuted` the given relations left out, with
    their contradiction; `adjusted` is None where the removals cut the group in two, or, with `unfixed`, left nothing
    that fixes the frame given from outside.
    """

    adjusted: Adjusted | None
    pairs: list[PairResult]
    refuted: dict[Key, tuple[Relation, Contradiction]]
    unfixed: bool = False


@dataclass(frozen=True)
class _Suspect:
    key: Key
    size: float
    is_pair: bool
    evidence: float
    nodes: tuple[str, ...]


def without_blunders(
    start: Mapping[str, Array],
    reference: str,
    pairs: Sequence[PairResult],
    centroids: Mapping[str, Array],
    options: NetworkOptions,
    given: Sequence[Relation] = (),
) -> Consistent:
    """Adjust one group and take out what contradicts all others.

    Parameters
    ----------
    start : mapping
        T_world of all members, frames given from outside among them; measurements start anew from the pairs left.
    """
    pairs, names = list(pairs), sorted(name for name in start if not name.startswith("<"))
    frames = {name: T for name, T in start.items() if name.startswith("<")}
    refuted: dict[Key, tuple[Relation, Contradiction]] = {}
    spared: set[Key] = set()
    overruled: set[Key] = set()
    while True:
        kept = [item for item in given if item.key not in refuted]
        if reference == GIVEN_FRAME and not fixes_given_frame(kept):
            return Consistent(None, pairs, refuted, unfixed=True)
        adjusted = adjust(_start(names, reference, pairs, frames, start), reference, pairs, centroids, options, kept)
        found = _suspects(adjusted, pairs, kept, options)
        if not found:
            back = _blameless(adjusted.joint, pairs, names, options, spared)
            if not back:
                changed = outvoted(adjusted, pairs, names, options)
                if changed is None or ("pair", changed[0].a, changed[0].b, "") in overruled:
                    return Consistent(adjusted, _with_final_reasons(adjusted.joint, pairs, names), refuted)
                overruled.add(("pair", changed[0].a, changed[0].b, ""))
                out = replace(changed[0], used=False, removed_reason=_OUTVOTED if changed[1] else _UNDECIDED)
                pairs = [out if p is changed[0] else p for p in pairs]
                if not changed[1]:
                    return Consistent(None, pairs, refuted)
                back = {(p.a, p.b) for p in changed[1]}
            pairs = [replace(p, used=True, removed_reason=None) if (p.a, p.b) in back else p for p in pairs]
            spared |= {("pair", a, b, "") for a, b in back}
            continue
        for suspect, equals in _worst_apart(found, pairs):
            contradiction = adjusted.contradictions[suspect.key]
            if suspect.is_pair:
                pairs = [_taken_out(p, contradiction, equals) if _is(p, suspect.key) else p for p in pairs]
            else:
                refuted[suspect.key] = next(i for i in kept if i.key == suspect.key), contradiction
        if len(find_groups(names, pairs)) > 1:
            return Consistent(None, pairs, refuted)


def _start(
    names: Sequence[str],
    reference: str,
    pairs: Sequence[PairResult],
    frames: Mapping[str, Array],
    start: Mapping[str, Array],
) -> dict[str, Array]:
    """Start transforms along the pairs that are left, in the world of `start`."""
    root = reference if reference in names else names[0]
    moved = start_transforms(names, root, pairs)
    return {**{name: start[root] @ T for name, T in moved.items()}, **frames}


def _is(pair: PairResult, key: Key) -> bool:
    return ("pair", pair.a, pair.b, "") == key


def _suspects(
    adjusted: Adjusted, pairs: Sequence[PairResult], given: Sequence[Relation], options: NetworkOptions
) -> list[_Suspect]:
    """Return what contradicts the others beyond what its statement allows, the worst first."""
    found = []
    for p in pairs:
        c = adjusted.contradictions.get(("pair", p.a, p.b, ""))
        if p.used and c is not None and c.mm > options.blunder_mm and c.sigma > options.blunder_sigma:
            found.append(_Suspect(("pair", p.a, p.b, ""), c.noise_sigma, True, p.log10_false_alarms, (p.a, p.b)))
    for item in given:
        c = adjusted.contradictions.get(item.key)
        if c is not None and c.chance < options.false_alarm / len(given):
            nodes = tuple(n for n in (item.a, item.b) if n not in (GIVEN_FRAME, ROBOT_FRAME))
            found.append(_Suspect(item.key, c.noise_sigma, False, 0.0, nodes))
    return sorted(found, key=lambda s: (-s.size, s.key))


def _worst_apart(
    found: Sequence[_Suspect], pairs: Sequence[PairResult]
) -> list[tuple[_Suspect, list[tuple[str, str]]]]:
    """Return those to take out now, each with the pairs that contradict the others as much as it does.

    A suspect stays where what lies within two pairs of it touches the same of a worse one: it may be its victim.
    """
    near: dict[str, set[str]] = {}
    for p in pairs:
        if p.used:
            near.setdefault(p.a, {p.a}).add(p.b)
            near.setdefault(p.b, {p.b}).add(p.a)
    taken: set[str] = set()
    chosen = []
    for worst in found:
        around = {two for n in worst.nodes for one in near.get(n, {n}) for two in near.get(one, {one})}
        if taken & around:
            continue
        equal = [s for s in found if s.size >= (1 - _EQUAL) * worst.size and around & set(s.nodes)]
        # What was given from outside is trusted less than a pair; of pairs the one with the weakest evidence goes.
        suspect = max(equal, key=lambda s: (not s.is_pair, s.evidence if s.is_pair else s.size, s.key))
        chosen.append((suspect, [s.key[1:3] for s in equal if s is not suspect and s.is_pair]))
        taken |= around
    return chosen


def _taken_out(pair: PairResult, c: Contradiction, equals: Sequence[tuple[str, str]]) -> PairResult:
    reason = f"contradicts the other pairs by {c.mm:.2f} mm ({c.sigma:.0f} sigma): taken out of the network"
    if equals:
        listed = ", ".join(f"{a} and {b}" for a, b in equals[:_MOST_NAMED])
        more = f" and {len(equals) - _MOST_NAMED} others" if len(equals) > _MOST_NAMED else ""
        reason += f"; the loop cannot tell it from {listed}{more}, it has the weakest evidence"
    return replace(pair, used=False, removed_reason=reason)


#: Why a pair goes that was kept at first.
_OUTVOTED = "contradicts the other pairs (by vote): taken out of the network, more of those that contradict it agree"
_UNDECIDED = "other pairs contradict it, as many and with as much evidence, so that nothing decides: none is used"

#: Pairs that one sentence names before it counts.
_MOST_NAMED = 3


def _against(joint: JointCovariance, pair: PairResult) -> tuple[float, float]:
    """Return by how much a pair that took no part contradicts the network: [mm], and sigma of noise and calibration."""
    assert pair.T_a_b is not None
    assert pair.covariance_noise is not None
    assert pair.covariance_point_mm is not None
    p = pair.covariance_point_mm
    other = joint.between(pair.a, pair.b)
    C = pair.covariance_noise + other.about(p).covariance_noise
    if pair.covariance_calibration is not None:
        C = C + pair.covariance_calibration
    gap = difference(pair.T_a_b, other.T_a_b, p)
    return float(np.linalg.norm(gap[3:])), float(np.sqrt(gap @ np.linalg.solve(C, gap) / 6))


def _blameless(
    joint: JointCovariance | None,
    pairs: Sequence[PairResult],
    names: Sequence[str],
    options: NetworkOptions,
    spared: set[Key],
) -> set[tuple[str, str]]:
    """Return pairs that were taken out but agree with the network that is left; each may come back once."""
    if joint is None:
        return set()
    members, back = set(names), set()
    for pair in pairs:
        if pair.removed_reason is None or not {pair.a, pair.b} <= members or ("pair", pair.a, pair.b, "") in spared:
            continue
        mm, sigma = _against(joint, pair)
        if mm <= options.blunder_mm or sigma <= options.blunder_sigma:
            back.add((pair.a, pair.b))
    return back


def _with_final_reasons(
    joint: JointCovariance | None, pairs: Sequence[PairResult], names: Sequence[str]
) -> list[PairResult]:
    """Say of what was taken out by how much it contradicts the network without any other blunder."""
    members, out = set(names), []
    for pair in pairs:
        if joint is not None and pair.removed_reason is not None and {pair.a, pair.b} <= members:
            mm, sigma = _against(joint, pair)
            rest = pair.removed_reason.partition(")")[2]
            reason = f"contradicts the other pairs by {mm:.2f} mm ({sigma:.0f} sigma){rest}"
            pair = replace(pair, removed_reason=reason)
        out.append(pair)
    return out
