"""Newton steps on the joint cost, coarse to fine, with observable directions only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from planish.geometry import Array, perturb
from planish.options import Options, thread_count
from planish.registration.refine.anchor import Anchor
from planish.registration.refine.information import held_directions, information
from planish.registration.refine.residuals import Equations, JointSide, Weights, equations


class RefineOptions(Options):
    """Options of the joint refinement."""

    #: Standard deviation of the Gaussian on the texture per level, coarse to fine [px].
    smoothing_px: tuple[PositiveFloat, ...] = (2.0, 0.8)
    #: Every n-th pixel per level.
    stride: tuple[PositiveInt, ...] = (2, 1)
    #: Surfaces farther apart than this do not belong together, per level [mm].
    max_distance_mm: tuple[PositiveFloat, ...] = (2.0, 1.0)
    #: Largest angle between the normals of the two surfaces [rad].
    max_normal_rad: float = Field(default=0.35, gt=0, lt=1.5)
    #: Most steps per level.
    max_steps: int = Field(default=15, ge=1)
    #: A level ends when a step moves no point of the overlap by more than this [mm].
    step_mm: float = Field(default=5e-4, gt=0)
    #: Half of what a direction may be uncertain by, to be updated at all [mm].
    max_sigma_mm: float = Field(default=2.0, gt=0)

    @model_validator(mode="after")
    def _one_value_per_level(self) -> Self:
        levels = len(self.smoothing_px)
        if levels == 0 or len(self.stride) != levels or len(self.max_distance_mm) != levels:
            raise ValueError("smoothing_px, stride and max_distance_mm must have one value per level, at least one")
        return self


@dataclass(frozen=True)
class Refined:
    """Result of the refinement: transform, the last normal equations and weights, the point xi refers to."""

    T_a_b: Array
    about: Array
    lever_mm: float
    equations: Equations
    weights: Weights
    converged: bool
    step_mm: float


def refine(
    sides_a: Mapping[float, JointSide],
    sides_b: Mapping[float, JointSide],
    T_a_b: Array,
    about: Array,
    lever_mm: float,
    tile_px: int,
    options: RefineOptions | None = None,
    threads: int | None = None,
    anchor: Anchor | None = None,
) -> Refined | None:
    """Return the refined transform of b in a, or None where the two hardly overlap.

    Parameters
    ----------
    sides_a, sides_b : mapping
        `JointSide` per smoothing of `options.smoothing_px`.
    T_a_b : ndarray (4, 4)
        Start, within a few millimetres.
    about : ndarray (3,)
        Point in frame a that rotations turn about: the centre of the overlap [mm].
    lever_mm : float
        Radius of the overlap; makes rotations comparable with translations [mm].
    anchor : Anchor, optional
        Windows of textures too weak for single pixels.
    """
    options = options or RefineOptions()
    count = thread_count(threads)
    weights: Weights | None = None
    result: Equations | None = None
    converged, step = False, np.inf
    levels = list(zip(options.smoothing_px, options.stride, options.max_distance_mm, strict=True))
    for smoothing, stride, max_distance in levels:
        a, b = sides_a[smoothing], sides_b[smoothing]

        def at(
            T: Array,
            w: Weights | None,
            residuals: bool,
            a: JointSide = a,
            b: JointSide = b,
            gate: float = max_distance,
            stride: int = stride,
        ) -> Equations:
            found = equations(
                a, b, T, about, w, max_distance_mm=gate, max_normal_rad=options.max_normal_rad,
                stride=stride, tile_px=tile_px, residuals=residuals, threads=count,
            )  # fmt: skip
            return found if anchor is None else anchor.hold(found, T, about)

        converged = False
        scalings = 1 if smoothing == levels[-1][0] else _SCALINGS
        for iteration in range(options.max_steps):
            # Scales follow the fit for the first steps, then stay, so that the cost is one function. The last level
            # starts from a good fit and needs them once.
            if iteration < scalings:
                plain = at(T_a_b, None, True)
                if plain.points < MIN_POINTS:
                    return None
                weights = Weights.from_residuals(plain, smoothing)
            result = at(T_a_b, weights, False)
            xi = _step(result, lever_mm, options.max_sigma_mm)
            T_a_b = perturb(T_a_b, xi, about)
            step = float(np.linalg.norm(xi[:3]) * lever_mm + np.linalg.norm(xi[3:]))
            if iteration + 1 >= scalings and step < options.step_mm:
                converged = True
                break
    assert weights is not None
    final = at(T_a_b, weights, False)
    return Refined(T_a_b, np.asarray(about), lever_mm, final, weights, converged, step)


#: Far from the solution the slope of the influence can vanish; a step then goes no farther than twice.
_MIN_SLOPE = 0.5
#: Times that the robust scales are estimated anew on a coarse level.
_SCALINGS = 3
#: Fewer common pixels than this cannot be refined (six unknowns, tiles for the covariance).
MIN_POINTS = 300


def _step(e: Equations, lever_mm: float, max_sigma_mm: float) -> Array:
    """Newton step with the expected curvature, without the directions that neither geometry nor texture holds."""
    info = information(e, lever_mm, _MIN_SLOPE)
    V, values = held_directions(info, max_sigma_mm)
    return -V @ ((V.T @ (info.scale * info.gradient)) / values)
