"""Pairs asked again where the network puts them: their cost, not the parabola about where they ended."""

from __future__ import annotations

import numpy as np
import pytest

import sheets
from planish.geometry import difference, perturb
from planish.registration.network.relinearise import quadratic
from planish.registration.pair import refine_pair
from planish.registration.pair_costs import pair_costs
from planish.registration.result import Motion, PairResult

#: Standard deviations of a pair [rad, mm].
SIGMA = np.array([3e-5] * 3 + [0.005] * 3)
#: The refinement ends at steps below 5e-4 mm.
CONVERGED_MM = 1e-3


@pytest.fixture(scope="module")
def prepared():
    return dict(zip("ab", sheets.pair(), strict=True))


@pytest.fixture(scope="module")
def refined(prepared):
    return refine_pair(prepared["a"], prepared["b"], sheets.T_TRUE)


def stopped(refined, mm, **changes):
    """The pair as if its refinement had ended `mm` beside its optimum."""
    T = perturb(refined.T_a_b, [0, 0, 0, mm, 0, 0], refined.about)
    return PairResult(
        "a", "b", "accepted", "", T_a_b=T, covariance_noise=np.diag(SIGMA**2), covariance_point_mm=refined.about,
        used=True, **changes,
    )  # fmt: skip


def optimum(equations, T, about):
    information, gradient = equations
    return perturb(T, np.linalg.solve(information, gradient), about)


def test_a_pair_that_stopped_beside_its_optimum_leads_there_from_where_the_network_puts_it(prepared, refined):
    pair = stopped(refined, 0.3)
    there = perturb(refined.T_a_b, [0, 0, 0, 0.05, 0.02, 0], refined.about)
    found = optimum(pair_costs(prepared)(pair, there), there, refined.about)
    assert np.linalg.norm(difference(found, refined.T_a_b, refined.about)[3:]) < CONVERGED_MM


def test_a_pair_that_the_network_hardly_moves_keeps_its_parabola(prepared, refined):
    pair = stopped(refined, 0.0)
    there = perturb(pair.T_a_b, SIGMA, refined.about)
    for one, two in zip(pair_costs(prepared)(pair, there), quadratic(pair, there), strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_pair_with_several_motions_keeps_its_parabola(prepared, refined):
    motion = Motion(np.eye(4), 9, 9, -9.0, False, (0, 0, 1, 1), (0, 0, 1, 1))
    pair = stopped(refined, 0.3, motions=(motion, motion))
    found = optimum(pair_costs(prepared)(pair, refined.T_a_b), refined.T_a_b, refined.about)
    np.testing.assert_allclose(found, pair.T_a_b, atol=1e-6)
