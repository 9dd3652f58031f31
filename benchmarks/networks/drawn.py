"""Synthetic networks: measurements of a panel, a ring or a chain with known truth, pairs drawn by their covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, compose, difference, exp_so3, invert, perturb, transform_points
from planish.registration.network.build import Node
from planish.registration.result import PairResult

#: Standard deviations of a pair about its overlap [rad, mm]: a plate with 3 % grain, an overlap of a third.
SIGMA = np.array([4e-5, 4e-5, 3e-5, 0.005, 0.005, 0.001])
#: Extent of a measurement [mm].
FIELD = (400.0, 300.0)


@dataclass(frozen=True)
class Truth:
    """True places T_object_measurement and centroids of measurements, and which of them overlap."""

    T: dict[str, Array]
    centroids: dict[str, Array]
    overlaps: list[tuple[str, str]]

    def T_a_b(self, a: str, b: str) -> Array:
        """Return the true T_a_b."""
        return invert(self.T[a]) @ self.T[b]

    def nodes(self, points=None) -> list[Node]:
        """Return the nodes of the network, with points per name where given."""
        return [Node(n, f"{n}.h5", "0", self.centroids[n], None if points is None else points[n]) for n in self.T]


def panel(columns: int, rows: int, seed: int = 0, overlap: float = 0.35, name: str = "m") -> Truth:
    """Measurements in a grid, each overlapping its neighbours, rolled and tilted; names in shuffled order."""
    rng = np.random.default_rng(seed)
    step = (1 - overlap) * np.array(FIELD)
    numbers = rng.permutation(columns * rows)
    at = {(x, y): f"{name}{numbers[y * columns + x]:04d}" for y in range(rows) for x in range(columns)}
    T, centroids = {}, {}
    for (x, y), key in at.items():
        turned = exp_so3(rng.uniform(-0.2, 0.2, 3)) @ np.diag([1.0, -1.0, -1.0])
        centroid = np.array([*rng.uniform(-5, 5, 2), 600 + rng.uniform(-30, 30)])
        place = np.array([*(np.array([x, y]) * step), 20 * np.sin(0.4 * x)])
        T[key], centroids[key] = compose(turned, place - turned @ centroid), centroid
    near = ((1, 0), (0, 1), (1, 1), (1, -1))
    overlaps = [
        (at[x, y], at[x + dx, y + dy]) for (x, y) in at for dx, dy in near if (x + dx, y + dy) in at
    ]  # fmt: skip
    return Truth(T, centroids, sorted(tuple(sorted(pair)) for pair in overlaps))


def ring(count: int, radius_mm: float = 400.0) -> Truth:
    """Measurements around a part, each overlapping the next, the last one the first."""
    T, centroids = {}, {}
    for i in range(count):
        turn = exp_so3([0, 2 * np.pi * i / count, 0])
        T[f"r{i:03d}"] = compose(turn, turn @ np.array([0, 0, -radius_mm - 600.0]))
        centroids[f"r{i:03d}"] = np.array([0.0, 0.0, 600.0])
    names = sorted(T)
    overlaps = [tuple(sorted((names[i], names[(i + 1) % count]))) for i in range(count)]
    return Truth(T, centroids, sorted(overlaps))


def draw_pair(truth: Truth, a: str, b: str, rng=None, error=None, scale: float = 1.0, **changes) -> PairResult:
    """Return an accepted pair, with noise where `rng` is given, wrong by `error` about its overlap."""
    T = truth.T_a_b(a, b)
    p = (truth.centroids[a] + transform_points(T, truth.centroids[b])) / 2
    # The covariance is known about the overlap, in directions that differ from pair to pair.
    mix = np.random.default_rng([ord(c) for c in a + b])
    R = exp_so3(mix.normal(0, 0.5, 3))
    A = np.kron(np.eye(2), R) @ np.diag(scale * SIGMA * mix.uniform(0.5, 2, 6))
    xi = np.zeros(6) if rng is None else A @ rng.standard_normal(6)
    xi = xi if error is None else xi + error
    defaults = {"log10_false_alarms": -100.0, "covariance_noise": A @ A.T, "covariance_point_mm": p, "used": True}
    return PairResult(a, b, "accepted", "", T_a_b=perturb(T, -xi, p), **{**defaults, **changes})


def draw_pairs(truth: Truth, seed: int | None = 0, wrong=None, **changes) -> list[PairResult]:
    """Return all pairs; `wrong` gives errors xi (6,) of some."""
    rng = None if seed is None else np.random.default_rng([seed, 7])
    wrong = wrong or {}
    return [draw_pair(truth, a, b, rng, wrong.get((a, b)), **changes) for a, b in truth.overlaps]


def shift(mm: float, seed: int) -> Array:
    """Return an error xi (6,) of this size along a drawn direction of the surface."""
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    return np.array([0, 0, 0, mm * np.cos(angle), mm * np.sin(angle), 0.0])


def misplaced(truth: Truth, placed, T_world_object=None) -> dict[str, Array]:
    """Return per measurement xi (6,) from its adjusted to its true place, about its covariance point."""
    out = {}
    for m in placed:
        T = truth.T[m.name] if T_world_object is None else T_world_object @ truth.T[m.name]
        out[m.name] = difference(T, m.T_world_measurement, m.covariance_point_mm)
    return out


def unused(pairs) -> set[tuple[str, str]]:
    """Return the names of accepted pairs that are not used."""
    return {(p.a, p.b) for p in pairs if p.status == "accepted" and not p.used}
