"""What the network is adjusted to: each relation says something about one transform T_a_b, whitened by its noise.

A pair, a robot's transform, a known point or a fitted surface: they differ only in how many directions they hold, and
by what. `a` may be a frame that no measurement has (`GIVEN_FRAME`, `ROBOT_FRAME`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from planish.geometry import Array, adjoint, translation
from planish.registration.network.batch import adjoints, inverses, logarithms, shifts
from planish.registration.result import PairResult

Kind = Literal["pair", "robot", "point", "surface", "start"]
#: The frame of known points and reference surfaces, and that of a robot: unknowns like the measurements.
GIVEN_FRAME, ROBOT_FRAME = "<given frame>", "<robot frame>"


@dataclass(frozen=True)
class Relation:
    """One observation of T_a_b.

    Parameters
    ----------
    kind, a, b, label : str
        What it is; `label` tells several of one kind between a and b apart.
    T_a_b : ndarray (4, 4)
        The transform it speaks for.
    point_a : ndarray (3,)
        Its error xi acts about this point [mm].
    root : ndarray (6, 6)
        root @ xi is white with variance one; its first `dof` rows, the others are zero.
    dof : int
        Directions that it holds.
    shifts : mapping or None
        Per rig the changes xi (k, 6) by its modes; None where they are not known.
    """

    kind: Kind
    a: str
    b: str
    label: str
    T_a_b: Array
    point_a: Array
    root: Array
    dof: int = 6
    shifts: Mapping[str, Array] | None = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What identifies it in one network."""
        return self.kind, self.a, self.b, self.label


def pair_relation(pair: PairResult) -> Relation:
    """Return what an accepted pair says."""
    assert pair.T_a_b is not None, "an accepted pair carries a transform"
    assert pair.covariance_noise is not None, "an accepted pair carries its covariance"
    assert pair.covariance_point_mm is not None, "an accepted pair carries the point of its covariance"
    return Relation(
        "pair", pair.a, pair.b, "", pair.T_a_b, pair.covariance_point_mm, whitening(pair.covariance_noise),
        shifts=pair.calibration_shifts,
    )  # fmt: skip


def whitening(covariance: Array) -> Array:
    """Return the root (6, 6) with root C root' = 1; directions without any error get the least that can be computed."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    values = np.maximum(values, _LEAST_VARIANCE * values[-1])
    return np.asarray((vectors / np.sqrt(values)).T / scale, np.float64)


#: Share of the largest eigenvalue of a correlation matrix below which only rounding is left.
_LEAST_VARIANCE = 1e-12


#: A frame that may be off by more than this, in any direction and at any of its points, is not fixed [mm].
_LOOSE_MM = 2000.0


def fixes_given_frame(relations: Sequence[Relation]) -> bool:
    """Return whether relations of the given frame, were all measurements one body, hold it in all directions."""
    known = [item for item in relations if item.a == GIVEN_FRAME]
    if not known:
        return False
    points = np.array([item.point_a for item in known])
    centre = points.mean(0)
    arm = max(1.0, float(np.sqrt(np.mean(np.sum((points - centre) ** 2, 1)))))
    scale = np.array([1 / arm] * 3 + [1.0] * 3)
    information = np.zeros((6, 6))
    for item in known:
        J = item.root @ adjoint(translation(centre - item.point_a)) * scale
        information += J.T @ J
    return bool(np.linalg.eigvalsh(information)[0] > 1 / _LOOSE_MM**2)


@dataclass(frozen=True)
class Linearised:
    """Whitened residuals r (E, 6) from the network to the relations, and by how much a motion of a and b lessens them.

    `by_a`, `by_b` (E, 6, 6): change of what the network says, whitened, by xi of a or b about its centroid in world.
    """

    r: Array
    by_a: Array
    by_b: Array


class Stack:
    """All relations of a network as arrays, so that one step treats all of them at once."""

    def __init__(self, relations: Sequence[Relation], index: Mapping[str, int]) -> None:
        self.relations = list(relations)
        self.a = np.array([index[item.a] for item in relations], np.int64)
        self.b = np.array([index[item.b] for item in relations], np.int64)
        self.T_a_b = np.array([item.T_a_b for item in relations]).reshape(-1, 4, 4)
        self.points = np.array([item.point_a for item in relations]).reshape(-1, 3)
        self.root = np.array([item.root for item in relations]).reshape(-1, 6, 6)
        self.dof = np.array([item.dof for item in relations], np.int64)

    def depth(self, start: int) -> int:
        """Return the number of relations from a member to the one farthest from it."""
        reached, count = {start}, 0
        beside: dict[int, set[int]] = {}
        for a, b in zip(self.a.tolist(), self.b.tolist(), strict=True):
            beside.setdefault(a, set()).add(b)
            beside.setdefault(b, set()).add(a)
        edge = {start}
        while edge:
            edge = set().union(*(beside.get(one, set()) for one in edge)) - reached
            reached |= edge
            count += bool(edge)
        return count

    def linearise(self, T: Array, centres: Array) -> Linearised:
        """Return residuals and derivatives at T_world (n, 4, 4) with centroids (n, 3) in world."""
        T_a_world = inverses(T[self.a])
        there, back = shifts(self.points), shifts(-self.points)
        r = logarithms(back @ self.T_a_b @ inverses(T_a_world @ T[self.b]) @ there)
        # A small motion of b about its centroid in world, seen in a about p; the same motion of a acts the other way.
        to_a = back @ T_a_world
        by_a = -self.root @ adjoints(to_a @ shifts(centres[self.a]))
        by_b = self.root @ adjoints(to_a @ shifts(centres[self.b]))
        return Linearised((self.root @ r[:, :, None])[:, :, 0], by_a, by_b)
