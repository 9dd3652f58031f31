"""Loops of pairs and how well they close; chains of pairs and how far they drift."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, adjoint, difference, invert, transform_points, translation
from planish.registration.network.adjust import common_shifts
from planish.registration.network.summary import Loop
from planish.registration.result import PairResult


@dataclass(frozen=True)
class Step:
    """One pair on a walk; `forward` where it is walked from a to b."""

    pair: PairResult
    forward: bool

    @property
    def T_here_there(self) -> Array:
        """The transform from where the step ends to where it begins."""
        assert self.pair.T_a_b is not None
        return self.pair.T_a_b if self.forward else invert(self.pair.T_a_b)


Graph = dict[str, dict[str, PairResult]]


def graph_of(pairs: Sequence[PairResult], names: Sequence[str]) -> Graph:
    """Return the pairs in use by both their names, neighbours in the order of their names."""
    graph: Graph = {name: {} for name in sorted(names)}
    for pair in pairs:
        if pair.used and pair.a in graph and pair.b in graph:
            graph[pair.a][pair.b] = graph[pair.b][pair.a] = pair
    return {name: dict(sorted(others.items())) for name, others in graph.items()}


def shortest_walk(graph: Graph, start: str, end: str, without: PairResult | None = None) -> list[Step] | None:
    """Return the walk of the fewest pairs from start to end (ties: the first names), or None."""
    came: dict[str, str] = {start: start}
    queue = deque([start])
    while queue and end not in came:
        here = queue.popleft()
        for other, pair in graph[here].items():
            if other not in came and pair is not without:
                came[other] = here
                queue.append(other)
    if end not in came:
        return None
    walk: list[Step] = []
    while end != start:
        pair = graph[came[end]][end]
        walk.append(Step(pair, pair.b == end))
        end = came[end]
    return walk[::-1]


def side_of(graph: Graph, start: str, beyond: str) -> list[str]:
    """Return what is reached from `start` without the pair to `beyond`."""
    reached, queue = {start}, [start]
    while queue:
        here = queue.pop()
        new = [n for n in graph[here] if n not in reached and (here, n) != (start, beyond)]
        reached.update(new)
        queue += new
    return sorted(reached)


def fundamental_loops(graph: Graph, tree: Sequence[tuple[str, str]]) -> list[list[Step]]:
    """Return, for each pair beside the tree, the shortest loop through it; a loop that several share once.

    Where these do not make up all loops (a ring whose last pair also closes a triangle), the tree's own loops are
    added that are none of their sums. The pair that closes a loop comes last and is walked from b to a.
    """
    kept = {frozenset(edge) for edge in tree}
    on_tree = {a: {b: pair for b, pair in others.items() if frozenset((a, b)) in kept} for a, others in graph.items()}
    pairs = {(pair.a, pair.b): pair for others in graph.values() for pair in others.values()}
    bits = {key: 1 << i for i, key in enumerate(sorted(pairs))}
    beside = [key for key in bits if frozenset(key) not in kept]
    loops, sums = [], _Sums()

    def take(key: tuple[str, str], walk: list[Step] | None) -> None:
        if walk is not None and sums.add(_members(walk, bits) | bits[key]):
            loops.append([*walk, Step(pairs[key], False)])

    for key in beside:
        take(key, shortest_walk(graph, *key, pairs[key]))
    if sums.rank < len(beside):
        for key in beside:
            take(key, shortest_walk(on_tree, *key))
    return loops


def _members(walk: Sequence[Step], bits: Mapping[tuple[str, str], int]) -> int:
    """Return the pairs of a walk as one number, a bit for each."""
    return sum(bits[step.pair.a, step.pair.b] for step in walk)


class _Sums:
    """Loops by their pairs, and which others are sums of them: pairs that stand twice cancel (arithmetic modulo 2)."""

    def __init__(self) -> None:
        self._by_highest: dict[int, int] = {}

    @property
    def rank(self) -> int:
        """Number of independent loops."""
        return len(self._by_highest)

    def add(self, loop: int) -> bool:
        """Add a loop, unless it is a sum of those that are there; return whether it was added."""
        while loop:
            other = self._by_highest.get(loop.bit_length())
            if other is None:
                self._by_highest[loop.bit_length()] = loop
                return True
            loop ^= other
        return False


@dataclass(frozen=True)
class Chain:
    """Pairs one after the other.

    `T_start_end` (4, 4) is what they say together; covariance (6, 6) and modes (6, k) of its error are about the origin
    of the frame where the chain starts.
    """

    T_start_end: Array
    covariance: Array
    modes: Array

    @classmethod
    def empty(cls, modes: int) -> Chain:
        """Return the chain of no pair, with so many modes of the rigs."""
        return cls(np.eye(4), np.zeros((6, 6)), np.zeros((6, modes)))

    def then(self, step: Step, shift: Array) -> Chain:
        """Return the chain with one more pair; its error is carried to the start by the adjoint.

        `shift` (6, k) is what each mode does to the pair.
        """
        after = self.T_start_end @ step.T_here_there
        T_start_a = self.T_start_end if step.forward else after
        p, C = step.pair.covariance_point_mm, step.pair.covariance_noise
        assert p is not None
        assert C is not None
        carry = adjoint(T_start_a @ translation(p))
        sign = 1.0 if step.forward else -1.0
        return Chain(after, self.covariance + carry @ C @ carry.T, self.modes + sign * carry @ shift)

    def error_about(self, point: Array) -> tuple[Array, Array]:
        """Return covariance (6, 6) and modes (6, k) about a point (3,) in the frame of the start [mm]."""
        carry = adjoint(translation(-point))
        return carry @ self.covariance @ carry.T, carry @ self.modes


def chain_of(walk: Sequence[Step]) -> Chain:
    """Return the chain of all pairs of a walk."""
    shifts = common_shifts([step.pair.calibration_shifts for step in walk])
    chain = Chain.empty(shifts.shape[2])
    for step, shift in zip(walk, shifts, strict=True):
        chain = chain.then(step, shift)
    return chain


def close(loop: Sequence[Step], residuals: Mapping[tuple[str, str], float]) -> Loop:
    """Return how well a loop closes; `residuals` [mm] is what the adjustment leaves in each pair."""
    closing = loop[-1].pair
    assert closing.covariance_point_mm is not None
    chain = chain_of(loop)
    covariance, modes = chain.error_about(closing.covariance_point_mm)
    xi = difference(chain.T_start_end, np.eye(4), closing.covariance_point_mm)
    total = covariance + modes @ modes.T
    names = [step.pair.a if step.forward else step.pair.b for step in loop]
    return Loop(
        measurements=tuple(names),
        closure_mm=float(np.linalg.norm(xi[3:])),
        closure_rad=float(np.linalg.norm(xi[:3])),
        predicted_mm=float(np.sqrt(np.trace(total[3:, 3:]))),
        sigma=float(np.sqrt(xi @ np.linalg.solve(total, xi) / 6)),
        adjusted_mm=max(residuals[step.pair.a, step.pair.b] for step in loop),
    )


def residual_mm(pair: PairResult, T_world: Mapping[str, Array]) -> float:
    """Return how far a pair puts its overlap from where the adjusted transforms put it [mm]."""
    assert pair.T_a_b is not None
    assert pair.covariance_point_mm is not None
    predicted = invert(T_world[pair.a]) @ T_world[pair.b]
    return float(np.linalg.norm(difference(pair.T_a_b, predicted, pair.covariance_point_mm)[3:]))


def chain_drift(
    chain: Chain, name: str, reference: str, T_world: Mapping[str, Array], centroid: Array
) -> tuple[float, float]:
    """Return how far a chain from the reference puts a centroid from its adjusted place, and its sigma [mm]."""
    adjusted = invert(T_world[reference]) @ T_world[name]
    point = np.asarray(transform_points(adjusted, np.asarray(centroid, float)))
    covariance, modes = chain.error_about(point)
    total = covariance + modes @ modes.T
    drift = float(np.linalg.norm(difference(chain.T_start_end, adjusted, point)[3:]))
    return drift, float(np.sqrt(np.trace(total[3:, 3:])))
