"""One group with all that is given from outside: its pairs first, then frames, points, robot and surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from planish.geometry import Array, invert, transform_points
from planish.registration.network.adjust import Adjusted, NetworkOptions, adjust
from planish.registration.network.blunders import Consistent, Key, without_blunders
from planish.registration.network.contradictions import Contradiction
from planish.registration.network.given import Given, point_relations, points_start, robot_relations, robot_start
from planish.registration.network.groups import start_transforms
from planish.registration.network.relations import GIVEN_FRAME, ROBOT_FRAME, Relation
from planish.registration.network.surface_fit import (
    FixedSurface,
    SurfaceHold,
    group_hold,
    held_directions,
    surface_hold,
    surface_relation,
)
from planish.registration.result import PairResult


class Placeable(Protocol):
    """What of a measurement is needed to place it."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def centroid_sensor(self) -> Array:
        """Its centroid (3,) in its own frame."""

    @property
    def points_sensor(self) -> Array | None:
        """Some of its points (N, 3)."""


@dataclass(frozen=True)
class Anchored:
    """A group with what was given: `adjusted` is None where what tied its parts together was taken out.

    `given_is_world` where the frame given from outside is the world; `not_held` its directions that nothing holds;
    `remarks` what a reader must know of the given.
    """

    adjusted: Adjusted | None
    pairs: list[PairResult]
    refuted: dict[Key, tuple[Relation, Contradiction]]
    kept: list[Relation] = field(default_factory=list)
    given_is_world: bool = False
    not_held: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    def with_pairs_of(self, other: Anchored) -> Anchored:
        """Return this with the pairs as `other` has them: as they were measured."""
        return replace(self, pairs=other.pairs)


def adjust_group(
    nodes: Sequence[Placeable], reference: str, pairs: Sequence[PairResult], options: NetworkOptions, given: Given
) -> Anchored:
    """Return one group, adjusted to its pairs and to all that is given of it, without what contradicts the rest."""
    centroids = {node.name: node.centroid_sensor for node in nodes}
    start = start_transforms(list(centroids), reference, pairs)
    first = without_blunders(start, reference, pairs, centroids, options)
    if first.adjusted is None or not _concerns(given, centroids):
        return Anchored(first.adjusted, first.pairs, {})
    T = dict(first.adjusted.T_world_measurement)
    T_world_given, why_not = points_start(given, T)
    T_world_robot = robot_start(given, T, centroids)
    remarks = () if why_not is None else (why_not,)
    relations: list[Relation] = []
    world_given = T_world_given
    if given.surface is not None and world_given is None:
        world_given = T_world_robot
        if world_given is None:
            remarks = (*remarks, "nothing says where it lies roughly in the frame of the fixed surface: not used")
    is_world = world_given is not None
    if world_given is not None:
        T = {name: invert(world_given) @ here for name, here in T.items()}
        T_world_robot = None if T_world_robot is None else invert(world_given) @ T_world_robot
        T[GIVEN_FRAME] = np.eye(4)
        if T_world_given is not None:
            relations += point_relations(given, {name: T[name] for name in centroids})
    if T_world_robot is not None:
        T[ROBOT_FRAME] = T_world_robot
        relations += robot_relations(given, list(centroids))
    datum = GIVEN_FRAME if is_world else reference
    not_held: tuple[str, ...] = ()
    if given.surface is not None and is_world:
        T, surface_relations, not_held = _on_surface(
            nodes, given.surface, T, first.pairs, centroids, options, relations
        )
        relations += surface_relations
    found = without_blunders(T, datum, first.pairs, centroids, options, relations)
    if found.unfixed:
        return _without_frame(nodes, reference, pairs, options, given, found)
    kept = [item for item in relations if item.key not in found.refuted]
    return _anchored(found, kept, is_world, not_held, remarks)


def _without_frame(
    nodes: Sequence[Placeable],
    reference: str,
    pairs: Sequence[PairResult],
    options: NetworkOptions,
    given: Given,
    found: Consistent,
) -> Anchored:
    """Return the group in its own world: of what is given, so much contradicts the rest that no frame is left."""
    anchored = adjust_group(nodes, reference, pairs, options, Given(robot=given.robot))
    named = ", ".join(f"{item.kind} {item.label or item.b}" for item, _ in found.refuted.values())
    remark = f"what is given contradicts itself or the pairs ({named}), and what is left fixes no frame: none is used"
    return replace(anchored, remarks=(*anchored.remarks, remark))


def _anchored(
    found: Consistent, kept: list[Relation], is_world: bool, not_held: tuple[str, ...], remarks: tuple[str, ...]
) -> Anchored:
    return Anchored(found.adjusted, found.pairs, found.refuted, kept, is_world, not_held, remarks)


def _concerns(given: Given, names: Mapping[str, Array]) -> bool:
    return given.surface is not None or bool(given.measurements & set(names))


#: The fit to a surface ends where no centroid moves by more than this [mm], or after so many steps.
_SURFACE_STEP_MM, _SURFACE_STEPS = 1e-4, 50


def _on_surface(
    nodes: Sequence[Placeable],
    surface: FixedSurface,
    T: dict[str, Array],
    pairs: Sequence[PairResult],
    centroids: Mapping[str, Array],
    options: NetworkOptions,
    relations: Sequence[Relation],
) -> tuple[dict[str, Array], list[Relation], tuple[str, ...]]:
    """Return transforms on the surface, what it says there, and in words which directions nothing holds."""
    points = {node.name: node.points_sensor for node in nodes}
    found: list[Relation] = []
    not_held: tuple[str, ...] = ()
    for _ in range(_SURFACE_STEPS):
        holds = {
            name: hold
            for name, item in points.items()
            if item is not None and (hold := surface_hold(surface, item, T[name])) is not None
        }
        if not holds:
            return T, [], ("the measurements do not lie on the surface",)
        found = [surface_relation(hold, name, T[name]) for name, hold in sorted(holds.items())]
        found = [item for item in found if item.dof]
        not_held = ()
        if not any(item.kind == "point" for item in relations):
            stay, not_held = _stay(group_hold(holds), sorted(holds)[0], T)
            found += stay
        moved = adjust(T, GIVEN_FRAME, pairs, centroids, options, [*relations, *found]).T_world_measurement
        steps = [
            np.linalg.norm(transform_points(moved[n], centroids[n]) - transform_points(T[n], centroids[n]))
            for n in points
        ]
        T = moved
        if max(steps) < _SURFACE_STEP_MM:
            break
    return T, found, not_held


#: What nothing holds stays at its start, and says so by this standard deviation [mm].
_NOTHING_MM = 1000.0


def _stay(hold: SurfaceHold, name: str, T: Mapping[str, Array]) -> tuple[list[Relation], tuple[str, ...]]:
    """Return a relation that keeps a group where a surface does not hold it, and these directions in words."""
    _, vectors, held = held_directions(hold)
    free = vectors[:, np.flatnonzero(~held)]
    if not free.shape[1]:
        return [], ()
    arm = np.array([hold.radius_mm] * 3 + [1.0] * 3)
    root = np.zeros((6, 6))
    root[: free.shape[1]] = (free * arm[:, None]).T / _NOTHING_MM
    return (
        [Relation("start", GIVEN_FRAME, name, "", T[name], hold.point, root, dof=free.shape[1])],
        tuple(_in_words(v) for v in free.T),
    )


def _in_words(direction: Array) -> str:
    rotation, shift = direction[:3], direction[3:]
    turns = bool(rotation @ rotation > shift @ shift)
    axis = rotation if turns else shift
    axis = axis / np.linalg.norm(axis)
    axis = axis if axis[int(np.argmax(np.abs(axis)))] > 0 else -axis
    return f"{'rotation about' if turns else 'shift along'} ({', '.join(f'{x:+.2f}' for x in axis)})"
