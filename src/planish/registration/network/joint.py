"""`network.h5`: the joint covariance of all measurements of each group, so that any two can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planish import storage
from planish.errors import InputError
from planish.geometry import Array, adjoint, invert, move_covariance, transform_points, translation
from planish.registration.network.blocks import SIZE, BlockCholesky

SCHEMA = "planish.network/1"


@dataclass(frozen=True)
class RelativeTransform:
    """T_a_b with its covariances (6, 6) about `point_a_mm` (3,), b's centroid in the frame of a."""

    T_a_b: Array
    covariance_noise: Array
    covariance_calibration: Array | None
    point_a_mm: Array

    def about(self, point_a: Array) -> RelativeTransform:
        """Return the same with covariances about another point (3,) of frame a [mm]."""
        noise = move_covariance(self.covariance_noise, self.point_a_mm, point_a)
        calibration = self.covariance_calibration
        if calibration is not None:
            calibration = move_covariance(calibration, self.point_a_mm, point_a)
        return RelativeTransform(self.T_a_b, noise, calibration, point_a)


@dataclass(frozen=True)
class JointCovariance:
    """What the adjustment of one group knows of all its measurements together.

    Parameters
    ----------
    members : ndarray (n,) of bytes
        Names in UTF-8: measurements, and frames given from outside, whose names begin with "<".
    datum : int
        Number of the member that does not move; it is no unknown of the factor.
    T_world_member : ndarray (n, 4, 4)
    centres_mm : ndarray (n, 3)
        Each one's covariance is about this point, its own centroid in world.
    factor : BlockCholesky
        Of the normal equations of all members but the datum, in their order.
    variance_factor : float
        The inverse of the normal equations times this is the covariance by noise.
    modes : ndarray (n, k, 6) or None
        Motion of each member by each mode of the rigs' errors; None where a pair states none.
    """

    members: NDArray[np.bytes_]
    datum: int
    T_world_member: Array
    centres_mm: Array = field(metadata={"unit": "mm"})
    factor: BlockCholesky
    variance_factor: float
    modes: Array | None

    @property
    def names(self) -> list[str]:
        """All members by name."""
        return [bytes(name).decode() for name in self.members]

    def between(self, a: str, b: str) -> RelativeTransform:
        """Return T_a_b and its covariance, from the joint covariance of both.

        Raises
        ------
        InputError
            Where one of them is no member of the group.
        """
        names = self.names
        for name in (a, b):
            if name not in names:
                raise InputError("measurement", f"found '{name}'", f"one of {names}")
        i, j = names.index(a), names.index(b)
        T_a_world = invert(self.T_world_member[i])
        T_a_b = T_a_world @ self.T_world_member[j]
        point = np.asarray(transform_points(T_a_world, self.centres_mm[j]))
        unit = np.zeros((len(names), SIZE, SIZE))
        # Motions about the own centroids in world, told in a about b's centroid; see Stack.linearise.
        unit[j] += adjoint(translation(-point) @ T_a_world @ translation(self.centres_mm[j])).T
        unit[i] -= adjoint(translation(-point) @ T_a_world @ translation(self.centres_mm[i])).T
        free = np.delete(np.arange(len(names)), self.datum)
        covariance = np.einsum("nij,nik->jk", unit[free], self.factor.solve(unit[free])) * self.variance_factor
        moved = None if self.modes is None else np.einsum("nij,nki->jk", unit, self.modes)
        return RelativeTransform(
            T_a_b, (covariance + covariance.T) / 2, None if moved is None else moved @ moved.T, point
        )


@dataclass(frozen=True)
class JointCovariances:
    """The joint covariance of each group, by its id as text; groups of one measurement have none."""

    groups: Mapping[str, JointCovariance]

    def between(self, a: str, b: str) -> RelativeTransform:
        """Return T_a_b and its covariance.

        Raises
        ------
        InputError
            Where the two are in no common group.
        """
        for group in self.groups.values():
            if {a, b} <= set(group.names):
                return group.between(a, b)
        raise InputError("measurements", f"found '{a}' and '{b}'", "two measurements of one group")

    def save(self, path: Path) -> None:
        """Write `network.h5`."""
        storage.save(path, self, SCHEMA)

    @classmethod
    def load(cls, path: Path) -> JointCovariances:
        """Read `network.h5`; errors name the file."""
        return storage.load(path, cls, SCHEMA)
