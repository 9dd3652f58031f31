"""From all pairs to a Registration: groups, references, blunders out, adjusted transforms, what the network found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from planish.geometry import Array, transform_points
from planish.registration.network.adjust import Adjusted, NetworkOptions
from planish.registration.network.anchor import Anchored, adjust_group
from planish.registration.network.given import Given
from planish.registration.network.groups import choose_reference, find_groups
from planish.registration.network.joint import JointCovariances
from planish.registration.network.relinearise import NormalEquations, at_the_network
from planish.registration.network.summarise import advise, describe_group, merge
from planish.registration.result import Group, PairResult, PlacedMeasurement, Registration


@dataclass(frozen=True)
class Node:
    """A measurement as the network sees it: its name, file, hash and centroid (3,) in its own frame [mm].

    `points_sensor` (N, 3) are some of its points, spread evenly; needed only for a fixed surface.
    """

    name: str
    file: str
    sha256: str
    centroid_sensor: Array
    points_sensor: Array | None = None


def build_network(
    nodes: Sequence[Node],
    pairs: Sequence[PairResult],
    options: NetworkOptions | None = None,
    *,
    reference: str | None = None,
    record: Mapping[str, Any] | None = None,
    versions: Mapping[str, str] | None = None,
    given: Given | None = None,
    normal_equations: NormalEquations | None = None,
) -> Registration:
    """Return the registration of all measurements.

    Parameters
    ----------
    nodes : sequence of Node
        All measurements of the run.
    pairs : sequence of PairResult
        All pairs that were tried.
    reference : str, optional
        Reference of the group that holds it; default the most central measurement of each group.
    record, versions : mapping, optional
        Options and versions to be kept in the result.
    given : Given, optional
        Known points, a robot's transforms, a surface of the part.
    normal_equations : callable, optional
        Information and gradient of a pair at another transform; default the pair's own, which is quadratic.
    """
    options, given = options or NetworkOptions(), given or Given()
    by_name = {node.name: node for node in nodes}
    done: list[tuple[list[str], str, Anchored]] = []
    waiting, settled = _split(list(by_name), pairs)
    while waiting:
        names, inside = waiting.pop(0)
        chosen = reference if reference in names else choose_reference(names, inside)
        assert chosen is not None
        anchored = adjust_group([by_name[name] for name in names], chosen, inside, options, given)
        if anchored.adjusted is None:
            # What tied its parts together was wrong.
            parts, between = _split(names, anchored.pairs)
            waiting, settled = parts + waiting, settled + between
            continue
        settled += anchored.pairs
        if normal_equations is not None:
            seen = at_the_network(anchored.pairs, anchored.adjusted, normal_equations)
            anchored = adjust_group([by_name[name] for name in names], chosen, seen, options, given).with_pairs_of(
                anchored
            )
        done.append((names, chosen, anchored))
    done.sort(key=lambda item: (-len(item[0]), item[0][0]))
    return _registration(by_name, _in_order(settled), done, record, versions, options, given)


def _split(
    names: Sequence[str], pairs: Sequence[PairResult]
) -> tuple[list[tuple[list[str], list[PairResult]]], list[PairResult]]:
    """Return the groups of names, each with the pairs inside it, and the pairs between groups."""
    groups = find_groups(names, pairs)
    group_of = {name: number for number, group in enumerate(groups) for name in group}
    inside: list[list[PairResult]] = [[] for _ in groups]
    between: list[PairResult] = []
    for pair in _in_order(pairs):
        number = group_of[pair.a]
        (inside[number] if group_of[pair.b] == number else between).append(pair)
    return list(zip(groups, inside, strict=True)), between


def _in_order(pairs: Sequence[PairResult]) -> list[PairResult]:
    """Return pairs sorted by name: sums must not depend on the order in which they come."""
    return sorted(pairs, key=lambda pair: (pair.a, pair.b))


def _registration(
    by_name: Mapping[str, Node],
    pairs: Sequence[PairResult],
    done: Sequence[tuple[list[str], str, Anchored]],
    record: Mapping[str, Any] | None,
    versions: Mapping[str, str] | None,
    options: NetworkOptions,
    given: Given,
) -> Registration:
    groups, placed, joints, summaries = [], [], {}, []
    centroids = {name: node.centroid_sensor for name, node in by_name.items()}
    for number, (names, reference, anchored) in enumerate(done):
        adjusted = anchored.adjusted
        assert adjusted is not None
        groups.append(Group(number, reference))
        placed += [_place(by_name[name], number, adjusted) for name in names]
        if adjusted.joint is not None:
            joints[str(number)] = adjusted.joint
        summaries.append(describe_group(number, names, reference, anchored, centroids, options, given))
    summary = merge(summaries, advise({name: i for i, item in enumerate(done) for name in item[0]}, pairs))
    return Registration(
        tuple(groups),
        tuple(sorted(placed, key=lambda m: m.name)),
        tuple(pairs),
        dict(record or {}),
        dict(versions or {}),
        summary,
        JointCovariances(joints),
    )


def _place(node: Node, group: int, adjusted: Adjusted) -> PlacedMeasurement:
    T = adjusted.T_world_measurement[node.name]
    moved = None if adjusted.calibration is None else adjusted.calibration[node.name]
    return PlacedMeasurement(
        node.name, node.file, node.sha256, group, T, adjusted.covariance[node.name],
        None if moved is None else moved.T @ moved,
        np.asarray(transform_points(T, node.centroid_sensor)),
    )  # fmt: skip
