"""Network adjustment: the transforms of all measurements that agree best with all pairs, by their covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from planish.geometry import Array
from planish.options import Options
from planish.registration.network.batch import adjoints, exponentials, moved_points, shifts
from planish.registration.network.blocks import BlockCholesky, factor
from planish.registration.network.contradictions import Contradiction, contradictions
from planish.registration.network.elimination import Elimination, Indices, eliminate
from planish.registration.network.joint import JointCovariance
from planish.registration.network.relations import Linearised, Relation, Stack, pair_relation
from planish.registration.result import PairResult


class NetworkOptions(Options):
    """Options of the network adjustment."""

    #: What does not move: the reference, or nothing (inner constraints: each measurement has its own uncertainty). A
    #: frame given from outside comes before both.
    datum: Literal["reference", "free"] = "reference"
    #: Gauss-Newton steps; pairs are good to far less than a degree, so that few are needed.
    max_steps: int = Field(default=20, ge=1)
    #: A pair in a loop that contradicts the others by more than this is a blunder [mm] ...
    blunder_mm: float = Field(default=0.5, gt=0)
    #: ... if it is also more than this many of its standard deviations.
    blunder_sigma: float = Field(default=6.0, gt=0)
    #: Known points, a robot's transforms and surfaces state their noise: chance leaves one of them out this often.
    false_alarm: float = Field(default=1e-3, gt=0, lt=1)


@dataclass(frozen=True)
class Adjusted:
    """Adjusted transforms of one group.

    Parameters
    ----------
    T_world_measurement : dict
        Per name, (4, 4); world is the reference's frame.
    covariance : dict
        Per name, (6, 6), of xi about the own centroid in world; zero for the reference.
    contradictions : dict
        Per key of a relation, against all others; see `Relation.key`.
    variance_factor : float
        Sum of squared normalised residuals of the pairs over their redundancy and what errors of the calibration add
        to it; 1 where there is no loop.
    calibration : dict or None
        Per name, the motions xi (k, 6) by all modes of all rigs, about the own centroid in world: errors of the
        calibration are common to all measurements of a rig. None where a pair in use states none.
    joint : JointCovariance
        All of them together.
    """

    T_world_measurement: dict[str, Array]
    covariance: dict[str, Array]
    contradictions: dict[tuple[str, str, str, str], Contradiction]
    variance_factor: float
    calibration: dict[str, Array] | None
    joint: JointCovariance | None


def adjust(
    start: Mapping[str, Array],
    reference: str,
    pairs: Sequence[PairResult],
    centroids: Mapping[str, Array],
    options: NetworkOptions | None = None,
    given: Sequence[Relation] = (),
) -> Adjusted:
    """Return the least-squares transforms of one group.

    Parameters
    ----------
    start : mapping
        T_world_measurement (4, 4) per name; frames given from outside stand among them.
    reference : str
        Its frame is the world; it does not move.
    pairs : sequence of PairResult
        Those with `used` count.
    centroids : mapping
        Centroid (3,) of each measurement in its own frame [mm]; that of other frames is their origin.
    given : sequence of Relation
        What is known beside the pairs.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where a measurement is held by nothing.
    """
    options = options or NetworkOptions()
    relations = [pair_relation(p) for p in pairs if p.used and p.a in start and p.b in start]
    relations += [item for item in given if item.a in start and item.b in start]
    return adjust_relations(start, reference, relations, centroids, options)


def adjust_relations(
    start: Mapping[str, Array],
    reference: str,
    relations: Sequence[Relation],
    centroids: Mapping[str, Array],
    options: NetworkOptions,
) -> Adjusted:
    """Do what `adjust` does, from relations."""
    names = sorted(start)
    index = {name: i for i, name in enumerate(names)}
    T = np.array([start[name] for name in names])
    own = np.array([np.asarray(centroids.get(name, np.zeros(3)), float) for name in names])
    stack = Stack(relations, index)
    # The reference is no unknown: -1.
    unknown = np.cumsum(np.arange(len(names)) != index[reference]) - 1
    unknown[index[reference]] = -1
    free = unknown >= 0
    lin, cholesky = stack.linearise(T, moved_points(T, own)), None
    tied = (unknown[stack.a] >= 0) & (unknown[stack.b] >= 0)
    pattern = eliminate(int(free.sum()), unknown[stack.a][tied], unknown[stack.b][tied])
    for _ in range(options.max_steps if free.any() else 0):
        cholesky, x = _step(stack, lin, unknown, pattern)
        centres = moved_points(T, own)[free]
        T[free] = shifts(centres) @ exponentials(x) @ shifts(-centres) @ T[free]
        lin = stack.linearise(T, moved_points(T, own))
        if np.abs(x).max() < _CONVERGED:
            break
    return _result(names, index[reference], T, own, stack, lin, cholesky, unknown, options)


#: Steps below this end the adjustment [rad, mm].
_CONVERGED = 1e-9


def _step(stack: Stack, lin: Linearised, unknown: Indices, pattern: Elimination) -> tuple[BlockCholesky, Array]:
    """Return the factor of the normal equations and the step (n, 6)."""
    count = int(unknown.max()) + 1
    a, b = unknown[stack.a], unknown[stack.b]
    to_a, to_b = np.swapaxes(lin.by_a, 1, 2), np.swapaxes(lin.by_b, 1, 2)
    at_a, at_b, both = a >= 0, b >= 0, (a >= 0) & (b >= 0)
    i = np.concatenate([a[at_a], b[at_b], a[both]])
    j = np.concatenate([a[at_a], b[at_b], b[both]])
    blocks = np.concatenate([(to_a @ lin.by_a)[at_a], (to_b @ lin.by_b)[at_b], (to_a @ lin.by_b)[both]])
    cholesky = factor(count, i, j, blocks, pattern)
    return cholesky, cholesky.solve(_right_hand_side(lin, lin.r[:, :, None], a, b, count))[:, :, 0]


def _right_hand_side(lin: Linearised, r: Array, a: Indices, b: Indices, count: int) -> Array:
    """Return J' r (n, 6, m) of whitened r (E, 6, m)."""
    rhs = np.zeros((count, 6, r.shape[2]))
    np.add.at(rhs, a[a >= 0], (np.swapaxes(lin.by_a, 1, 2) @ r)[a >= 0])
    np.add.at(rhs, b[b >= 0], (np.swapaxes(lin.by_b, 1, 2) @ r)[b >= 0])
    return rhs


def _result(
    names: Sequence[str],
    reference: int,
    T: Array,
    own: Array,
    stack: Stack,
    lin: Linearised,
    cholesky: BlockCholesky | None,
    unknown: Indices,
    options: NetworkOptions,
) -> Adjusted:
    placed = dict(zip(names, T, strict=True))
    if cholesky is None:
        zero = {name: np.zeros((6, 6)) for name in names}
        return Adjusted(placed, zero, {}, 1.0, None, None)
    a, b, free = unknown[stack.a], unknown[stack.b], np.flatnonzero(unknown >= 0)
    shift = common_shifts([item.shifts for item in stack.relations])
    # The network follows the pairs' errors by the gain of the least squares, one mode of a rig at a time.
    moved = np.zeros((len(names), 6, shift.shape[2]))
    moved[free] = cholesky.solve(_right_hand_side(lin, stack.root @ shift, a, b, len(free)))
    left = stack.root @ shift - lin.by_a @ moved[stack.a] - lin.by_b @ moved[stack.b]
    hat = _hat(cholesky, lin, a, b)
    tests = contradictions(stack, lin, hat, left, stack.depth(reference))
    variance = _variance_factor(stack, lin, hat, left)
    # Loops that close worse than the pairs' covariances promise speak for errors that those leave out.
    widening = max(1.0, variance)
    covariance = np.zeros((len(names), 6, 6))
    every = np.arange(len(free))
    covariance[free] = cholesky.inverse_blocks(every, every) * widening
    centres = moved_points(T, own)
    stated = bool(stack.relations) and all(item.shifts is not None for item in stack.relations)
    members = np.array([name.encode() for name in names])
    joint = JointCovariance(
        members, reference, T, centres, cholesky, widening, np.swapaxes(moved, 1, 2) if stated else None
    )
    # A frame given from outside is what covariances are asked for: no other datum takes its place.
    if options.datum == "free" and not names[reference].startswith("<"):
        covariance, moved = _free_network(covariance, moved, centres, joint, names, stack)
    return Adjusted(
        placed,
        dict(zip(names, covariance, strict=True)),
        {item.key: test for item, test in zip(stack.relations, tests, strict=True)},
        variance,
        dict(zip(names, np.swapaxes(moved, 1, 2), strict=True)) if stated else None,
        joint,
    )


def _hat(cholesky: BlockCholesky, lin: Linearised, a: Indices, b: Indices) -> Array:
    """Return the whitened covariance (E, 6, 6) of what the network says of each relation."""
    hat = np.zeros((len(a), 6, 6))
    part: Array
    for i, j, left, right in ((a, a, lin.by_a, lin.by_a), (b, b, lin.by_b, lin.by_b), (a, b, lin.by_a, lin.by_b)):
        at = np.flatnonzero((i >= 0) & (j >= 0))
        part = left[at] @ cholesky.inverse_blocks(i[at], j[at]) @ np.swapaxes(right[at], 1, 2)
        hat[at] += part if left is right else part + np.swapaxes(part, 1, 2)
    return hat


def _variance_factor(stack: Stack, lin: Linearised, hat: Array, left: Array) -> float:
    pairs = np.array([item.kind == "pair" for item in stack.relations], bool)
    controlled = float(np.sum(6 - np.trace(hat, axis1=1, axis2=2)[pairs]))
    # Errors of the rig that measurements do not share alike open loops too: they are expected.
    expected = controlled + float(np.sum(left[pairs] ** 2))
    return float(np.sum(lin.r[pairs] ** 2)) / expected if controlled > _NO_REDUNDANCY * len(pairs) else 1.0


#: Redundancy per pair below which only rounding is left of it.
_NO_REDUNDANCY = 1e-6


def _free_network(
    covariance: Array, moved: Array, centres: Array, joint: JointCovariance, names: Sequence[str], stack: Stack
) -> tuple[Array, Array]:
    """Return covariances (n, 6, 6) and modes (n, 6, k) under inner constraints (S-transformation, Baarda 1973).

    Among all ways to fix the frame it is the one with the least trace: no measurement is exempt from uncertainty.
    """
    measured = np.array([not name.startswith("<") for name in names])
    # Rotations count as the motion they make at the distance of the overlaps.
    there = moved_points(joint.T_world_member[stack.a], stack.points)
    arm = float(np.sqrt(np.mean(np.sum((there - centres[stack.a]) ** 2, 1)))) or 1.0
    weights = measured[:, None, None] * np.array([arm**2] * 3 + [1.0] * 3)[:, None]
    G = adjoints(shifts(-centres))  # a rigid motion of the world about its origin, seen at each centroid
    weighted = weights * G
    along = G @ np.linalg.inv(np.einsum("nij,nik->jk", G, weighted))
    free = np.delete(np.arange(len(names)), joint.datum)
    Y = np.zeros_like(G)
    Y[free] = joint.factor.solve(weighted[free]) * joint.variance_factor
    Z = np.einsum("nij,nik->jk", weighted, Y)
    cross = along @ np.swapaxes(Y, 1, 2)
    out = covariance - cross - np.swapaxes(cross, 1, 2) + along @ Z @ np.swapaxes(along, 1, 2)
    return out, moved - along @ np.einsum("nij,nik->jk", weighted, moved)


def common_shifts(stated: Sequence[Mapping[str, Array] | None]) -> Array:
    """Return per relation its shifts (E, 6, k) by all modes of all rigs in the group; zero by rigs of others."""
    modes = {key: len(xi) for shift in stated for key, xi in (shift or {}).items()}
    at, count = {}, 0
    for key in sorted(modes):
        at[key], count = count, count + modes[key]
    out = np.zeros((len(stated), 6, count))
    for e, shift in enumerate(stated):
        for key, xi in (shift or {}).items():
            out[e, :, at[key] : at[key] + len(xi)] = xi.T
    return out
