"""The costs of pairs for the network: asked again where the network puts them, by the joint refinement from there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from planish.geometry import Array, difference
from planish.registration.network.relinearise import NormalEquations, quadratic
from planish.registration.options import PairOptions
from planish.registration.pair import is_weak, refine_pair
from planish.registration.prepared import Prepared
from planish.registration.result import PairResult


def pair_costs(
    prepared: Mapping[str, Prepared],
    options: PairOptions | None = None,
    threads: int | None = None,
    beyond_sigma: float = 3.0,
) -> NormalEquations:
    """Return normal equations of pairs from their images and points, at any transform.

    Parameters
    ----------
    prepared : mapping of Prepared
        All measurements by name.
    beyond_sigma : float
        Pairs that the network moves by less than this many of their standard deviations keep their own parabola:
        there it is their cost. So do pairs that windows of weak textures held, or in which several things moved: what
        held them is not known here.
    """
    chosen = options or PairOptions()

    def normal_equations(pair: PairResult, T_a_b: Array) -> tuple[Array, Array]:
        information, gradient = quadratic(pair, T_a_b)
        away = np.linalg.solve(information, gradient)
        if np.sqrt(away @ gradient / 6) < beyond_sigma or pair.motions:
            return information, gradient
        a, b = prepared[pair.a], prepared[pair.b]
        if is_weak(a, b, chosen.dense):
            return information, gradient
        # The slope there times the expected curvature misses the optimum by a share of the way; the solution does not.
        found = refine_pair(a, b, T_a_b, chosen, threads)
        if found is None or not found.converged or pair.covariance_point_mm is None:
            return information, gradient
        return information, information @ difference(found.T_a_b, T_a_b, pair.covariance_point_mm)

    return normal_equations
