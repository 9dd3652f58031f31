"""The tiles that took no part in a fit judge it."""

from __future__ import annotations

from dataclasses import replace

import pytest

import sheets
from planish.geometry import perturb
from planish.registration.pair import kept_out_agreement, refine_pair
from planish.registration.refine.covariance import noise_covariance
from planish.registration.refine.kept_out import Agreement
from planish.registration.verdict.geometry import Sight
from planish.registration.verdict.hypothesis import Drift
from planish.registration.verdict.judge import VerdictOptions, judge_refined


@pytest.fixture(scope="module")
def pair():
    return sheets.pair()


@pytest.fixture(scope="module")
def refined(pair):
    return refine_pair(*pair, sheets.T_TRUE)


def test_a_right_fit_is_not_contradicted(pair, refined):
    found = kept_out_agreement(*pair, refined, noise_covariance(refined))
    assert found.directions == 6
    assert not found.contradicts
    assert found.factor == 1


def test_a_fit_that_is_off_by_more_than_it_states_is_contradicted(pair, refined):
    covariance = noise_covariance(refined)
    sigma_mm = covariance[3, 3] ** 0.5
    off = replace(refined, T_a_b=perturb(refined.T_a_b, [0, 0, 0, 40 * sigma_mm, 0, 0], refined.about))
    found = kept_out_agreement(*pair, off, covariance)
    assert found.contradicts
    assert found.factor > 10


def test_no_common_tile_says_nothing(pair, refined):
    far = replace(refined, T_a_b=perturb(refined.T_a_b, [0, 0, 0, 0, 0, 50.0], refined.about))
    found = kept_out_agreement(*pair, far, noise_covariance(refined))
    assert found.directions == 0
    assert found.factor == 1


def test_a_contradiction_of_millimetres_is_refused(refined):
    sight, options = Sight(meet=1000, hidden=0), VerdictOptions()
    judged = judge_refined(refined, (), Drift(0.1), sight, options, None, Agreement(600.0, 6, 2.5))
    assert judged.status == "refused"
    assert "kept out of the fit, lies 2.50 mm off" in judged.reason
    assert judge_refined(refined, (), Drift(0.1), sight, options, None, Agreement(6.0, 6, 2.5)) is None
    assert judge_refined(refined, (), Drift(0.1), sight, options, None, Agreement(600.0, 6, 0.1)) is None
