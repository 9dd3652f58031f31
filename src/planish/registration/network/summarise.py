"""The summary of a network: loops, drift, ties, tests of what was given, advice for what stays apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from planish.geometry import Array
from planish.registration.network.adjust import Adjusted, NetworkOptions, common_shifts
from planish.registration.network.anchor import Anchored
from planish.registration.network.contradictions import Contradiction
from planish.registration.network.given import Given
from planish.registration.network.groups import spanning_tree
from planish.registration.network.loops import (
    Chain,
    Graph,
    Step,
    chain_drift,
    close,
    fundamental_loops,
    graph_of,
    residual_mm,
    side_of,
)
from planish.registration.network.relations import GIVEN_FRAME, ROBOT_FRAME, Relation
from planish.registration.network.summary import Advice, Frame, GivenTest, NetworkSummary, Place, Tie
from planish.registration.network.votes import LITTLE_REDUNDANCY
from planish.registration.result import PairResult

#: Names that one sentence lists before it counts.
_MOST_NAMED = 6


def describe_group(
    number: int,
    names: Sequence[str],
    reference: str,
    anchored: Anchored,
    centroids: Mapping[str, Array],
    options: NetworkOptions,
    given: Given,
) -> NetworkSummary:
    """Return the summary of one group."""
    adjusted = anchored.adjusted
    assert adjusted is not None
    T = adjusted.T_world_measurement
    used = [p for p in anchored.pairs if p.used]
    graph, tree = graph_of(used, names), spanning_tree(names, reference, used)
    edges = [(pair.a, pair.b) for pair in tree.values() if pair is not None]
    residuals = {(p.a, p.b): residual_mm(p, T) for p in used}
    ties = tuple(_tie(p, adjusted, residuals[p.a, p.b], options) for p in used)
    tests = _given_tests(anchored, given)
    return NetworkSummary(
        variance_factors={str(number): adjusted.variance_factor} if used else {},
        loops=tuple(close(loop, residuals) for loop in fundamental_loops(graph, edges)),
        ties=ties,
        places=_places(names, reference, tree, adjusted, centroids),
        given=tests,
        frames=_frames(number, anchored),
        warnings=(
            *(f"group {number}: {remark}" for remark in anchored.remarks),
            *_not_held(number, anchored.not_held),
            *_hanging(ties, graph, anchored.pairs),
            *(f"{t.kind} of {t.measurement}: {t.reason}" for t in tests if t.reason is not None),
        ),
    )


def _not_held(number: int, directions: Sequence[str]) -> list[str]:
    if not directions:
        return []
    return [f"group {number}: not held by the fixed surface, but kept as at the start: {', '.join(directions)}."]


def merge(groups: Sequence[NetworkSummary], advice: Sequence[Advice]) -> NetworkSummary:
    """Return the summaries of all groups as one, with advice for what no pair connects."""
    sentences = [
        f"Groups {a.groups[0]} and {a.groups[1]} stay apart. {a.a} and {a.b} came closest: {a.reason}" for a in advice
    ]
    return NetworkSummary(
        variance_factors={key: value for item in groups for key, value in item.variance_factors.items()},
        loops=tuple(x for item in groups for x in item.loops),
        ties=tuple(x for item in groups for x in item.ties),
        places=tuple(x for item in groups for x in item.places),
        advice=tuple(advice),
        given=tuple(x for item in groups for x in item.given),
        frames=tuple(x for item in groups for x in item.frames),
        warnings=(*(x for item in groups for x in item.warnings), *sentences),
    )


def advise(group_of: Mapping[str, int], pairs: Sequence[PairResult]) -> list[Advice]:
    """Return, for each group but the largest, the pair to another group with the most evidence, and why it is none."""
    best: dict[int, PairResult] = {}
    for pair in sorted(pairs, key=lambda p: (p.log10_false_alarms, p.a, p.b)):
        one, two = group_of[pair.a], group_of[pair.b]
        for group in {one, two} if one != two else ():
            best.setdefault(group, pair)
    out: list[Advice] = []
    for group in sorted(best):
        pair = best[group]
        one, two = sorted((group_of[pair.a], group_of[pair.b]))
        if group and all((a.a, a.b) != (pair.a, pair.b) for a in out):
            out.append(
                Advice(
                    groups=(one, two), a=pair.a, b=pair.b, log10_false_alarms=pair.log10_false_alarms,
                    reason=pair.removed_reason or pair.reason,
                )
            )  # fmt: skip
    return out


def _tie(pair: PairResult, adjusted: Adjusted, residual: float, options: NetworkOptions) -> Tie:
    c = adjusted.contradictions[("pair", pair.a, pair.b, "")]
    detectable = None if c.weakest_mm is None else max(options.blunder_mm, options.blunder_sigma * c.weakest_mm)
    return Tie(
        a=pair.a, b=pair.b, redundancy=c.redundancy, detectable_mm=detectable,
        residual_mm=residual,
    )  # fmt: skip


def _places(
    names: Sequence[str],
    reference: str,
    tree: Mapping[str, PairResult | None],
    adjusted: Adjusted,
    centroids: Mapping[str, Array],
) -> tuple[Place, ...]:
    edges = [pair for pair in tree.values() if pair is not None]
    shifts = common_shifts([pair.calibration_shifts for pair in edges])
    shift_of = {(pair.a, pair.b): shift for pair, shift in zip(edges, shifts, strict=True)}
    chains: dict[str, tuple[int, Chain]] = {}
    out = []
    for name, pair in tree.items():
        count, chain = 0, Chain.empty(shifts.shape[2])
        if pair is not None:
            count, chain = chains[pair.a if pair.b == name else pair.b]
            count, chain = count + 1, chain.then(Step(pair, pair.b == name), shift_of[pair.a, pair.b])
        chains[name] = count, chain
        drift, sigma = chain_drift(chain, name, reference, adjusted.T_world_measurement, centroids[name])
        C = adjusted.covariance[name]
        if adjusted.calibration is not None:
            C = C + adjusted.calibration[name].T @ adjusted.calibration[name]
        own = float(np.sqrt(max(0.0, np.trace(C[3:, 3:]))))
        out.append(Place(name=name, pairs_from_reference=count, chain_mm=drift, chain_sigma_mm=sigma, sigma_mm=own))
    return tuple(sorted(out, key=lambda place: place.name))


def _hanging(ties: Sequence[Tie], graph: Graph, pairs: Sequence[PairResult]) -> list[str]:
    """Return a sentence for each pair whose error nothing would notice."""
    out = []
    for tie in ties:
        if tie.redundancy > LITTLE_REDUNDANCY:
            continue
        side = side_of(graph, tie.a, tie.b)
        if tie.b in side:
            continue
        side = min((side, side_of(graph, tie.b, tie.a)), key=lambda s: (len(s), s))
        listed = _listed(side)
        what = f"{listed} hangs" if len(side) == 1 else f"{listed} hang"
        sentence = f"{what} on one pair, {tie.a} and {tie.b}: if it is wrong, nothing would notice."
        if tie.redundancy:
            unseen = "" if tie.detectable_mm is None else f" by less than {tie.detectable_mm:.1f} mm"
            sentence = f"{what} on one pair, {tie.a} and {tie.b}: if it is wrong{unseen}, nothing would notice."
        against = [p for p in pairs if p.removed_reason is not None and (p.a in side) != (p.b in side)]
        if against:
            sentence += f" Others that contradict it were taken out: {_listed([f'{p.a} and {p.b}' for p in against])}."
        out.append(sentence)
    return out


def _listed(items: Sequence[str]) -> str:
    more = f" and {len(items) - _MOST_NAMED} more" if len(items) > _MOST_NAMED else ""
    return ", ".join(items[:_MOST_NAMED]) + more


def _given_tests(anchored: Anchored, given: Given) -> tuple[GivenTest, ...]:
    adjusted = anchored.adjusted
    assert adjusted is not None
    tests = [_given_test(item, adjusted.contradictions[item.key], True) for item in anchored.kept]
    tests += [_given_test(item, c, False) for item, c in anchored.refuted.values()]
    return tuple(sorted((t for t in tests if t is not None), key=lambda t: (t.kind, t.measurement, t.target or "")))


def _given_test(item: Relation, c: Contradiction, used: bool) -> GivenTest | None:
    if item.kind not in ("point", "robot", "surface"):
        return None
    what = {"point": f"known point {item.label}", "robot": "robot's transform", "surface": "fixed surface"}[item.kind]
    reason = f"the {what} contradicts all others by {c.mm:.2f} mm ({c.sigma:.1f} sigma): ignored"
    return GivenTest(
        kind=item.kind, measurement=item.b, target=item.label or None, used=used, residual_mm=c.mm,
        sigma=c.sigma, redundancy=c.redundancy, reason=None if used else reason,
    )  # fmt: skip


def _frames(number: int, anchored: Anchored) -> tuple[Frame, ...]:
    assert anchored.adjusted is not None
    T = anchored.adjusted.T_world_measurement
    out = []
    if GIVEN_FRAME in T:
        out.append(
            Frame(
                group=number, kind="given", T_world_frame=T[GIVEN_FRAME].tolist(), is_world=anchored.given_is_world,
                not_held=anchored.not_held,
            )
        )  # fmt: skip
    if ROBOT_FRAME in T:
        out.append(Frame(group=number, kind="robot", T_world_frame=T[ROBOT_FRAME].tolist(), is_world=False))
    return tuple(out)
