"""From all pairs to a Registration: blunders out, groups, references, adjusted transforms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planish.geometry import Array, transform_points
from planish.registration.network.adjust import Adjusted, NetworkOptions, adjust
from planish.registration.network.groups import choose_reference, find_groups, path_exists, start_transforms
from planish.registration.result import Group, PairResult, PlacedMeasurement, Registration


@dataclass(frozen=True)
class Node:
    """A measurement as the network sees it: its name, file, hash and centroid (3,) in its own frame [mm]."""

    name: str
    file: str
    sha256: str
    centroid_sensor: Array


def build_network(
    nodes: Sequence[Node],
    pairs: Sequence[PairResult],
    options: NetworkOptions | None = None,
    *,
    reference: str | None = None,
    record: Mapping[str, Any] | None = None,
    versions: Mapping[str, str] | None = None,
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
    """
    options = options or NetworkOptions()
    centroids = {node.name: node.centroid_sensor for node in nodes}
    # Sums must not depend on the order in which the pairs come.
    pairs = sorted(pairs, key=lambda pair: (pair.a, pair.b))
    groups, placed = [], []
    by_name = {node.name: node for node in nodes}
    for number, names in enumerate(find_groups(list(by_name), pairs)):
        chosen = reference if reference in names else choose_reference(names, pairs)
        assert chosen is not None
        adjusted, pairs = _adjust_without_blunders(names, chosen, pairs, centroids, options)
        groups.append(Group(number, chosen))
        placed += [_place(by_name[name], number, adjusted) for name in names]
    return Registration(
        tuple(groups),
        tuple(sorted(placed, key=lambda m: m.name)),
        tuple(pairs),
        dict(record or {}),
        dict(versions or {}),
    )


def _adjust_without_blunders(
    names: Sequence[str],
    reference: str,
    pairs: list[PairResult],
    centroids: Mapping[str, Array],
    options: NetworkOptions,
) -> tuple[Adjusted, list[PairResult]]:
    """Adjust one group; take out the worst pair of a loop that does not close, one at a time."""
    while True:
        adjusted = adjust(start_transforms(names, reference, pairs), reference, pairs, centroids, options)
        # In a lone triangle all three contradict alike: the pair with the weakest evidence goes.
        suspects = [
            (round(adjusted.noise_sigma[p.a, p.b], 6), p.log10_false_alarms, i)
            for i, p in enumerate(pairs)
            if (p.a, p.b) in adjusted.residual_mm
            and adjusted.residual_mm[p.a, p.b] > options.blunder_mm
            and adjusted.residual_sigma[p.a, p.b] > options.blunder_sigma
            and path_exists(p.a, p.b, pairs[:i] + pairs[i + 1 :])
        ]
        if not suspects:
            return adjusted, pairs
        _, _, worst = max(suspects)
        pair = pairs[worst]
        sigma = adjusted.residual_sigma[pair.a, pair.b]
        reason = (
            f"contradicts the other pairs by {adjusted.residual_mm[pair.a, pair.b]:.2f} mm ({sigma:.0f} sigma): "
            "taken out of the network"
        )
        pairs[worst] = replace(pair, used=False, removed_reason=reason)


def _place(node: Node, group: int, adjusted: Adjusted) -> PlacedMeasurement:
    T = adjusted.T_world_measurement[node.name]
    moved = None if adjusted.calibration is None else adjusted.calibration[node.name]
    return PlacedMeasurement(
        node.name, node.file, node.sha256, group, T, adjusted.covariance[node.name],
        None if moved is None else moved.T @ moved,
        np.asarray(transform_points(T, node.centroid_sensor)),
    )  # fmt: skip
