"""What users know beside the pairs: known points and a robot's transforms, as relations that are tested like pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from planish.geometry import Array, compose, fit_rigid, invert, transform_points
from planish.registration.network.relations import GIVEN_FRAME, ROBOT_FRAME, Relation, whitening
from planish.registration.network.surface_fit import FixedSurface


@dataclass(frozen=True)
class Target:
    """A target's coordinates (3,) [mm] in some frame, and their standard deviation per axis [mm]."""

    name: str
    point_mm: Array
    sigma_mm: float


@dataclass(frozen=True)
class RobotTransform:
    """Where a robot says a measurement was: T_robot_measurement with the covariance of its error about a point."""

    T_robot_measurement: Array
    covariance: Array
    point_robot_mm: Array


@dataclass(frozen=True)
class Given:
    """All that is given from outside.

    Parameters
    ----------
    world_targets : mapping
        Known targets by name, in the given frame.
    seen_targets : mapping
        Per measurement the targets that it sees, in its own frame.
    robot : mapping
        Per measurement what a robot says.
    surface : FixedSurface or None
        Surface of the part in the given frame.
    """

    world_targets: Mapping[str, Target] = field(default_factory=dict)
    seen_targets: Mapping[str, Sequence[Target]] = field(default_factory=dict)
    robot: Mapping[str, RobotTransform] = field(default_factory=dict)
    surface: FixedSurface | None = None

    @property
    def measurements(self) -> set[str]:
        """Names of the measurements that something is known of."""
        return {*self.seen_targets, *self.robot}


#: The second extent of known points must exceed this many of their standard deviations to hold a rotation.
_LEAST_EXTENT = 10.0


def points_start(given: Given, T_world: Mapping[str, Array]) -> tuple[Array | None, str | None]:
    """Return T_world_given (4, 4) by all known points that a group sees, or None and why the points do not give it."""
    here, there, sigmas = [], [], []
    for name in sorted(T_world):
        for seen in given.seen_targets.get(name, ()):
            known = given.world_targets[seen.name]
            here.append(transform_points(T_world[name], seen.point_mm))
            there.append(known.point_mm)
            sigmas.append(float(np.hypot(known.sigma_mm, seen.sigma_mm)))
    if not here:
        return None, None
    points = np.array(there)
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False) / np.sqrt(len(points))
    if len(points) < 3 or extents[1] < _LEAST_EXTENT * max(sigmas):
        return (
            None,
            f"{len(points)} known points that do not span a triangle: they do not fix the frame and are not used",
        )
    return fit_rigid(here, points, 1 / np.square(sigmas)), None


def point_relations(given: Given, T_given: Mapping[str, Array]) -> list[Relation]:
    """Return what known points say of measurements at about T_given_measurement."""
    out = []
    for name in sorted(T_given):
        R = T_given[name][:3, :3]
        for seen in given.seen_targets.get(name, ()):
            known = given.world_targets[seen.name]
            root = np.zeros((6, 6))
            root[:3, 3:] = np.eye(3) / np.hypot(known.sigma_mm, seen.sigma_mm)
            # The rotation is that of the start: only the place of the point is known.
            T = compose(R, known.point_mm - R @ seen.point_mm)
            out.append(Relation("point", GIVEN_FRAME, name, seen.name, T, known.point_mm, root, dof=3))
    return out


def robot_start(given: Given, T_world: Mapping[str, Array], centroids: Mapping[str, Array]) -> Array | None:
    """Return T_world_robot (4, 4) by the measurement whose statement suits most others: a few may be wrong."""
    names = sorted(set(T_world) & set(given.robot))
    if not names:
        return None
    T_robot = np.array([given.robot[name].T_robot_measurement for name in names])
    own = np.array([centroids[name] for name in names])
    there = np.einsum("nij,nj->ni", T_robot[:, :3, :3], own) + T_robot[:, :3, 3]
    here = np.array([transform_points(T_world[name], np.asarray(centroids[name], float)) for name in names])
    candidates = [T_world[name] @ invert(T) for name, T in zip(names, T_robot, strict=True)]
    misfits = [float(np.median(np.linalg.norm(transform_points(T, there) - here, axis=1))) for T in candidates]
    return candidates[int(np.argmin(np.round(misfits, 9)))]


def robot_relations(given: Given, names: Sequence[str]) -> list[Relation]:
    """Return what the robot says of measurements; its frame is an unknown of the network."""
    return [
        Relation(
            "robot", ROBOT_FRAME, name, "", given.robot[name].T_robot_measurement, given.robot[name].point_robot_mm,
            whitening(given.robot[name].covariance),
        )
        for name in sorted(set(names) & set(given.robot))
    ]  # fmt: skip
