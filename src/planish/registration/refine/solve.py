"""Newton steps on the joint cost, coarse to fine, with observable directions only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from planish.geometry import Array, perturb
from planish.options import Options, thread_count
from planish.registration.refine.information import held_directions, information
from planish.registration.refine.residuals import Equations, Weights, equations
from planish.registration.refine.samples import samples
from planish.registration.refine.shading import shading, without_shading
from planish.registration.refine.sides import JointSide


class RefineOptions(Options):
    """Options of the joint refinement."""

    #: Every n-th pixel per level, coarse to fine; what these cannot hold is averaged away before.
    spacing_px: tuple[PositiveInt, ...] = (8, 4, 2, 1)
    #: Surfaces farther apart than this do not belong together, per level [mm]; a start may be off by the first.
    max_distance_mm: tuple[PositiveFloat, ...] = (3.0, 2.0, 1.0, 1.0)
    #: By so much a start may be turned: at the rim of the overlap the surfaces lie farther apart by that [rad].
    start_turn_rad: float = Field(default=float(np.deg2rad(0.5)), ge=0, lt=0.1)
    #: Largest angle between the normals of the two surfaces [rad].
    max_normal_rad: float = Field(default=0.35, gt=0, lt=1.5)
    #: Most steps per level.
    max_steps: int = Field(default=15, ge=1)
    #: A level ends when a step moves no point of the overlap by more than this, or is small against the noise [mm].
    step_mm: float = Field(default=5e-4, gt=0)
    #: Half of what a direction may be uncertain by, to be updated at all [mm].
    max_sigma_mm: float = Field(default=2.0, gt=0)

    @model_validator(mode="after")
    def _one_value_per_level(self) -> Self:
        if not self.spacing_px or len(self.spacing_px) != len(self.max_distance_mm):
            raise ValueError("spacing_px and max_distance_mm must have one value per level, at least one")
        return self

    def starting_within(self, distance_mm: float, gsd_mm: float) -> Self:
        """Return the options for a start that is off by less: without the levels that only lead here from farther.

        Coarse levels see little but slow changes, of which shading has its share.
        """
        reach = [n * gsd_mm >= distance_mm for n in self.spacing_px]
        first = max([i for i, enough in enumerate(reach) if enough], default=0)
        of_levels = {"spacing_px": self.spacing_px[first:], "max_distance_mm": self.max_distance_mm[first:]}
        # No point is off by more: whatever turn there is, is counted.
        turn = {"start_turn_rad": 0.0} if np.isfinite(distance_mm) else {}
        return self.model_copy(update=of_levels | turn)

    def first_gate_mm(self, lever_mm: float) -> float:
        """Return how far apart the surfaces of an overlap of this root mean square radius may lie at a start [mm]."""
        return self.max_distance_mm[0] + self.start_turn_rad * _RIM * lever_mm


#: The farthest point of a strip, in root mean square distances of its points from the middle; of a disc it is nearer.
_RIM = float(np.sqrt(3))


@dataclass(frozen=True)
class Refined:
    """Result of the refinement: transform, the normal equations its last step was made by, weights, xi's point."""

    T_a_b: Array
    about: Array
    lever_mm: float
    equations: Equations
    weights: Weights
    converged: bool
    step_mm: float


def refine(
    sides_a: Mapping[int, JointSide],
    sides_b: Mapping[int, JointSide],
    T_a_b: Array,
    about: Array,
    lever_mm: float,
    tile_px: int,
    options: RefineOptions | None = None,
    threads: int | None = None,
) -> Refined | None:
    """Return the refined transform of b in a, or None where the two hardly overlap.

    Parameters
    ----------
    sides_a, sides_b : mapping
        `JointSide` per spacing of `options.spacing_px`.
    T_a_b : ndarray (4, 4)
        Start, within a few millimetres.
    about : ndarray (3,)
        Point in frame a that rotations turn about: the centre of the overlap [mm].
    lever_mm : float
        Radius of the overlap; makes rotations comparable with translations [mm].
    tile_px : int
        Edge of the tiles of b that the covariance rests on [px].
    """
    options = options or RefineOptions()
    problem = _Problem(np.asarray(about), lever_mm, tile_px, options, thread_count(threads))
    found: Refined | None = None
    gates = (options.first_gate_mm(lever_mm), *options.max_distance_mm[1:])
    for spacing, max_distance in zip(options.spacing_px, gates, strict=True):
        level = problem.solve(sides_a[spacing], sides_b[spacing], T_a_b, max_distance)
        if level is not None:
            found, T_a_b = level, level.T_a_b
        elif spacing == options.spacing_px[-1]:
            return None
    return found


#: Far from the solution the slope of the influence can vanish; a step then goes no farther than twice.
_MIN_SLOPE = 0.5
#: Times that the weights are estimated anew on a coarse level. The last one starts from a good fit and needs them once.
_WEIGHINGS = 2
#: Fewer common pixels than this cannot be refined (six unknowns, tiles for the covariance).
MIN_POINTS = 300
#: Every n-th pixel of the whole resolution along both axes tells how large the residuals are.
_WEIGHING_STRIDE = 3


@dataclass(frozen=True)
class _Problem:
    """What all levels share."""

    about: Array
    lever_mm: float
    tile_px: int
    options: RefineOptions
    threads: int

    def at(self, a: JointSide, b: JointSide, T: Array, weights: Weights, max_distance_mm: float) -> Equations:
        return equations(
            a, b, T, self.about, weights, max_distance_mm=max_distance_mm, max_normal_rad=self.options.max_normal_rad,
            stride=1, tile_px=max(2, self.tile_px // b.spacing_px), residuals=False, threads=self.threads,
        )  # fmt: skip

    def weights(self, a: JointSide, b: JointSide, T: Array, max_distance_mm: float, last: bool) -> Weights | None:
        """Return what residuals count, None where too little is common; on the last level without their shading.

        The tiles of coarse levels hold too few values for it.
        """
        spacing = b.spacing_px
        stride, enough = -(-_WEIGHING_STRIDE // spacing), MIN_POINTS // spacing**2
        some = samples(
            a, b, T, max_distance_mm=max_distance_mm, max_normal_rad=self.options.max_normal_rad, stride=stride,
            tile_px=max(2, self.tile_px // spacing), threads=self.threads,
        )  # fmt: skip
        if some.points * stride**2 < enough:
            return None
        noise_passed = (a.noise_passed + b.noise_passed) / 2
        weights = Weights.from_residuals(some.sums(), noise_passed)
        if not last:
            return weights
        found = shading(some.sums(weights))
        rest = some.sums(Weights.alike(b, some.tile).shaded(found))
        return Weights.from_residuals(rest, noise_passed).shaded(found)

    def solve(self, a: JointSide, b: JointSide, T: Array, max_distance_mm: float) -> Refined | None:
        """Return the solution of one level, None where too little is common."""
        spacing, last = b.spacing_px, b.spacing_px == self.options.spacing_px[-1]
        weighings = 1 if last else _WEIGHINGS
        weights, converged, step = None, False, np.inf
        for iteration in range(self.options.max_steps):
            # Weights follow the fit for the first steps, then stay, so that the cost is one function.
            if iteration < weighings:
                weights = self.weights(a, b, T, max_distance_mm, last)
            if weights is None:
                return None
            result = self.at(a, b, T, weights, max_distance_mm)
            result = without_shading(result) if last else result
            xi, sigmas = _step(result, self.lever_mm, self.options.max_sigma_mm, afar=not last)
            T = perturb(T, xi, self.about)
            step = float(np.linalg.norm(xi[:3]) * self.lever_mm + np.linalg.norm(xi[3:]))
            if step < self.options.step_mm * (1 if last else spacing * _LOOSE) or (last and sigmas < _CLOSE):
                converged = True
                break
        assert weights is not None
        return Refined(T, self.about, self.lever_mm, result, weights, converged, step)


#: A coarse level need not be solved closer than this, in parts of what the last one must be: a step of a tenth of its
#: pixels leaves less than the next level's own.
_LOOSE = 50.0
#: After a step shorter than this many standard deviations nothing is left that counts: the next one is several times
#: shorter still.
_CLOSE = 0.3


def _step(e: Equations, lever_mm: float, max_sigma_mm: float, afar: bool) -> tuple[Array, float]:
    """Newton step with the expected curvature, without the directions that neither geometry nor texture holds.

    Also returns its length in standard deviations, root mean square over those that are held.
    """
    info = information(e, lever_mm, _MIN_SLOPE, afar)
    V, values = held_directions(info, max_sigma_mm)
    gradient = V.T @ (info.scale * info.gradient)
    across = V * info.scale[:, None]
    sigmas = np.sqrt(gradient @ np.linalg.solve(across.T @ info.noise @ across, gradient) / max(len(values), 1))
    return -V @ (gradient / values), float(sigmas)
