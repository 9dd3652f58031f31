"""Surfaces in the object frame, seen from +z; rays are intersected exactly in the core.

Surface coordinates (s, t) run along the surface in millimetres: (x, y) for panels, (arc length, y) for cylinders,
whose axis is parallel to y and whose highest line is the y axis of the object frame.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from planish import _core
from planish.errors import InputError
from planish.geometry import Array


@dataclass(frozen=True)
class Surface:
    """A sheet with the outline |s| <= half_s, |t| <= half_t [mm] and rounded corners of radius `corner` [mm]."""

    kind: ClassVar[str]
    half_s: float
    half_t: float
    corner: float = 0.0

    @property
    def kernel_values(self) -> dict[str, Any]:
        """The numbers of this surface for the core."""
        return {"kind": self.kind, **{key: float(value) for key, value in asdict(self).items()}}

    def intersect(self, origins: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Return the first points (N, 3) [mm] on rays (N, 3), the unit normals (N, 3) and (s, t) (N, 2); NaN = miss."""
        origins = np.ascontiguousarray(origins, float)
        hits = np.full((len(origins), 8), np.nan)
        _core.intersect_surface(self.kernel_values, origins, np.ascontiguousarray(directions, float), hits)
        return hits[:, :3], hits[:, 3:6], hits[:, 6:]

    def point_and_normal(self, s: float, t: float) -> tuple[Array, Array]:
        """Return the point (3,) [mm] and the outward unit normal (3,) at surface coordinates [mm]."""
        points, normals, _ = self.intersect(*self._ray_onto(s, t))
        if not np.isfinite(points).all():
            raise InputError(
                "surface coordinates",
                f"found ({s:g}, {t:g}) mm",
                f"a point of the {self.kind}, |s| <= {self.half_s:g}, |t| <= {self.half_t:g}",
            )
        return points[0], normals[0]

    def _ray_onto(self, s: float, t: float) -> tuple[Array, Array]:
        return np.array([[s, t, 1e3]]), np.array([[0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Plate(Surface):
    """A flat plate, z = 0."""

    kind: ClassVar[str] = "plate"
    half_s: float = 500.0
    half_t: float = 350.0


@dataclass(frozen=True)
class Step(Surface):
    """A flat plate whose half x >= 0 is `step` [mm] higher."""

    kind: ClassVar[str] = "step"
    half_s: float = 500.0
    half_t: float = 350.0
    step: float = 0.2


@dataclass(frozen=True)
class Waves(Surface):
    """A plate with shallow waves that repeat: z = amplitude cos(2 pi x / wavelength) [mm]."""

    kind: ClassVar[str] = "waves"
    half_s: float = 500.0
    half_t: float = 350.0
    amplitude: float = 0.5
    wavelength: float = 40.0


@dataclass(frozen=True)
class Cylinder(Surface):
    """Part of a cylinder, seen from outside: geometry slides along and around it.

    A negative radius makes a hollow, seen from inside, so shallow that no part of it hides another.
    """

    kind: ClassVar[str] = "cylinder"
    half_s: float = 320.0
    half_t: float = 500.0
    radius: float = 400.0

    def _ray_onto(self, s: float, t: float) -> tuple[Array, Array]:
        out = np.array([np.sin(s / self.radius), 0.0, np.cos(s / self.radius)])
        axis = np.array([0.0, t, -self.radius])
        return (axis + max(2 * self.radius, 0.0) * out)[None], -out[None]


@dataclass(frozen=True)
class Pipe(Cylinder):
    """A full pipe; its texture has a seam opposite to its highest line, as a welded pipe has."""

    half_s: float = 150.0 * np.pi
    half_t: float = 400.0
    radius: float = 150.0


@dataclass(frozen=True)
class Door(Surface):
    """A car-door panel: two curvatures, a raised character line, an elliptic recess with steep walls [mm].

    The character line is a ridge `line_height` high along y = line_y + line_slope x that runs out over `line_fade`; its
    crest is rounded to the radius line_edge line_fade / line_height. The recess falls by `recess_depth` over about four
    times `recess_wall` of its half axes, steepest by recess_depth / (4 recess_wall half_axis).
    """

    kind: ClassVar[str] = "door"
    half_s: float = 580.0
    half_t: float = 380.0
    corner: float = 70.0
    radius_x: float = 4500.0
    radius_y: float = 1400.0
    line_y: float = 110.0
    line_slope: float = 0.06
    line_height: float = 5.0
    line_edge: float = 4.0
    line_fade: float = 60.0
    recess_x: float = 330.0
    recess_y: float = 10.0
    recess_half_x: float = 85.0
    recess_half_y: float = 38.0
    recess_depth: float = 12.0
    recess_wall: float = 0.06
