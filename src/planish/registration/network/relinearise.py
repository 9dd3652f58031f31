"""Pairs seen from the network: their joint residuals where the network puts them, not where each one ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from planish.geometry import Array, difference, invert, perturb
from planish.registration.network.adjust import Adjusted
from planish.registration.result import PairResult

#: Information (6, 6) and downhill gradient (6,) of a pair's cost at a transform T_a_b, about its covariance point.
NormalEquations = Callable[[PairResult, Array], tuple[Array, Array]]


def quadratic(pair: PairResult, T_a_b: Array) -> tuple[Array, Array]:
    """Return what the pair itself says of its cost: a parabola about its optimum, by its covariance."""
    assert pair.T_a_b is not None
    assert pair.covariance_noise is not None
    assert pair.covariance_point_mm is not None
    W = np.asarray(np.linalg.inv(pair.covariance_noise), np.float64)
    return W, W @ difference(pair.T_a_b, T_a_b, pair.covariance_point_mm)


def at_the_network(
    pairs: Sequence[PairResult], adjusted: Adjusted, normal_equations: NormalEquations
) -> list[PairResult]:
    """Return the pairs as parabolas that touch their costs at the transforms of the network.

    The inverse of the information is the pair's covariance there; pairs that are not used stay as they are.
    """
    T, out = adjusted.T_world_measurement, []
    for pair in pairs:
        if not pair.used:
            out.append(pair)
            continue
        assert pair.covariance_point_mm is not None
        T_a_b = invert(T[pair.a]) @ T[pair.b]
        information, gradient = normal_equations(pair, T_a_b)
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        optimum = perturb(T_a_b, covariance @ gradient, pair.covariance_point_mm)
        out.append(replace(pair, T_a_b=optimum, covariance_noise=covariance))
    return out
