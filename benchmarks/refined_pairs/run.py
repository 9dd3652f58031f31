"""A pair with its truth, as the benchmarks of the refinement use it: prepared once, refined from many starts.

All that these benchmarks know of the registration's inside stands here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coarse_pairs.parts import Case, Part, true_transform
from planish.evaluation.overlap import OverlapEvaluation, evaluate_overlap
from planish.evaluation.prepared import Prepared as Evaluated
from planish.evaluation.truth import error_rms, true_overlap
from planish.geometry import Array, perturb, transform_points
from planish.measurement import Measurement
from planish.pipeline import prepare_run
from planish.registration.options import PairOptions
from planish.registration.pair import refine_pair, register_pair
from planish.registration.prepared import Prepared
from planish.registration.result import PairResult


@dataclass(frozen=True)
class KnownPair:
    """Two prepared measurements of one part and the truth about them."""

    options: PairOptions
    a: Prepared
    b: Prepared
    T_a_b: Array

    @cached_property
    def sides(self) -> tuple[Evaluated, Evaluated]:
        """Both measurements for the evaluation, which shares what the registration has computed."""
        a, b = (Evaluated(p.measurement, p.surface, p.contrast) for p in (self.a, self.b))
        return a, b

    @cached_property
    def overlap(self) -> tuple[float, NDArray[np.bool_]]:
        """The true overlap, and the pixels (H, W) of b in it."""
        return true_overlap(*self.sides, self.T_a_b, 1)

    @cached_property
    def points_b(self) -> Array:
        """Points (N, 3) of b in the true overlap [mm]."""
        return self.b.measurement.points_sensor[self.overlap[1]].astype(float)

    @cached_property
    def centre(self) -> Array:
        """Centroid (3,) of the true overlap in frame a [mm]."""
        return np.asarray(transform_points(self.T_a_b, self.points_b.mean(0)))

    def errors_mm(self, T_a_b: Array) -> tuple[float, float]:
        """Return the errors along the surface and along its normal over the true overlap, root mean square [mm]."""
        rms = error_rms(T_a_b, self.T_a_b, self.sides[1], self.overlap[1])
        assert rms is not None
        return rms

    def distance_mm(self, first: Array, second: Array) -> float:
        """Return how far apart two transforms put the overlap, root mean square [mm]."""
        points = self.points_b[:: max(1, len(self.points_b) // 2000)]
        d = transform_points(first, points) - transform_points(second, points)
        return float(np.sqrt((d**2).sum(1).mean()))

    def register(self, threads: int = 1) -> PairResult:
        """Return what the whole registration says of the pair, without any start."""
        return register_pair(self.a, self.b, self.options, 1, threads)

    def refine(self, T_a_b: Array, threads: int = 1) -> Array | None:
        """Return the refined transform from a start, or None where the refinement gives up."""
        found = refine_pair(self.a, self.b, T_a_b, self.options, threads)
        return None if found is None else found.T_a_b

    def evaluate(self, T_a_b: Array, threads: int = 1) -> OverlapEvaluation:
        """Return what the evaluation without truth says of a transform."""
        return evaluate_overlap(*self.sides, T_a_b, threads=threads)


def known_pair(measured: tuple[Measurement, Measurement], T_a_b: Array) -> KnownPair:
    """Prepare two measurements alone, as a run of two."""
    options, prepared = prepare_run(list(measured), threads=1)
    a, b = (prepared[m.name] for m in measured)
    return KnownPair(options, a, b, T_a_b)


def known_pairs(part: Part, cases: list[Case], measured: Mapping[int, Measurement]) -> dict[Case, KnownPair]:
    """Prepare all measurements of a part, as one run, and return the pairs of the cases that were measured."""
    options, prepared = prepare_run(list(measured.values()), threads=1)
    by_index = {index: prepared[m.name] for index, m in measured.items()}
    return {
        case: KnownPair(options, by_index[case.first], by_index[case.second], true_transform(part, case))
        for case in cases
        if {case.first, case.second} <= set(by_index)
    }


def moved(T_a_b: Array, centre: Array, rng: np.random.Generator, shift_mm: float, turn_deg: float) -> Array:
    """Return the transform with a shift and a turn about a point of frame a, both in random directions of space."""
    turn, shift = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return perturb(T_a_b, np.concatenate([np.deg2rad(turn_deg) * turn, shift_mm * shift]), centre)
