"""The verdict: what chance explains is refused, what stands still is refused, what repeats is ambiguous."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from math import comb, log10

import numpy as np
import pytest

import matched
import sheets
from matched import T_TRUE
from planish.geometry import exp_se3
from planish.registration.consensus import find_consensus
from planish.registration.pair import prepare, refine_pair
from planish.registration.refine.covariance import noise_covariance, observability
from planish.registration.result import Direction
from planish.registration.verdict.false_alarms import log10_false_alarms
from planish.registration.verdict.judge import VerdictOptions, judge_coarse, judge_refined, runner_up
from planish.registration.verdict.still import same_sensor, standing_still

#: Accuracy of the incomplete beta function, as a logarithm.
LOG_TOLERANCE = 1e-6
OPTIONS = VerdictOptions()


def exact(places, all_places, chance, pairs):
    p = Fraction(chance)
    n, k = all_places - 2, places - 2
    tail = sum(comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k, n + 1))
    value = pairs * Fraction(all_places * (all_places - 1), 2) * tail
    return log10(value.numerator) - log10(value.denominator)


@pytest.mark.parametrize("places", [3, 4, 9, 30, 60])
@pytest.mark.parametrize("chance", [1e-5, 1e-3, 0.1, 0.6])
def test_false_alarms_are_tests_times_the_binomial_tail(places, chance):
    stated = log10_false_alarms(places, 60, chance, 10)
    assert stated == pytest.approx(exact(places, 60, chance, 10), abs=LOG_TOLERANCE)


def test_false_alarms_far_below_the_range_of_doubles_stay_right():
    # Only the first term of the tail is taken there.
    assert log10_false_alarms(300, 400, 1e-4, 1) == pytest.approx(exact(300, 400, 1e-4, 1), abs=1e-3)


def test_more_agreement_is_never_more_likely_by_chance():
    for chance in (1e-6, 1e-3, 0.05, 1.0):
        stated = [log10_false_alarms(k, 500, chance, 3) for k in range(500)]
        assert np.isfinite(stated).all()
        assert (np.diff(stated) <= 1e-9).all()


def test_more_matches_pairs_or_chance_make_false_alarms_likelier():
    base = log10_false_alarms(12, 200, 1e-3, 1)
    assert log10_false_alarms(12, 400, 1e-3, 1) > base
    assert log10_false_alarms(12, 200, 2e-3, 1) > base
    assert log10_false_alarms(12, 200, 1e-3, 100) == pytest.approx(base + 2)


@pytest.mark.parametrize(("places", "all_places"), [(0, 0), (2, 2), (3, 2), (3, 1), (3, 3), (5, 4)])
def test_false_alarms_are_finite_for_any_small_number(places, all_places):
    assert np.isfinite(log10_false_alarms(places, all_places, 0.01, 1))


def judge(groups, total, still=0.0, pairs=1, seed=0):
    _, b, matches = matched.pair(np.random.default_rng(seed), total, groups)
    coarse = find_consensus(matches)
    return judge_coarse(coarse, runner_up(coarse, b.points_sensor.mean(0), pairs), still, pairs, OPTIONS)


def test_a_consensus_far_above_chance_is_accepted():
    judgement = judge(((40, T_TRUE),), 300)
    assert judgement.status == "accepted"
    assert "of 300 matched places agree" in judgement.reason or "matched places agree (10^-" in judgement.reason


def test_random_matches_are_refused_as_chance():
    judgement = judge(((4, T_TRUE),), 300)
    assert judgement.status == "refused"
    assert "which chance explains" in judgement.reason


@pytest.mark.parametrize("total", [0, 2, 30])
def test_where_no_three_places_agree_the_pair_is_refused(total):
    matches = matched.pair(np.random.default_rng(3), total)[2]
    judgement = judge_coarse(find_consensus(matches), None, 0.0, 1, OPTIONS)
    assert judgement.status == "refused"
    assert "no consensus" in judgement.reason


def test_what_stands_still_in_the_image_is_refused():
    judgement = judge(((40, T_TRUE),), 300, still=0.9)
    assert judgement.status == "refused"
    assert "stands still" in judgement.reason
    assert "90 %" in judgement.reason


def test_two_transforms_with_much_support_are_ambiguous():
    judgement = judge(((60, T_TRUE), (50, T_TRUE @ exp_se3([0, 0, 0, 35, 0, 0]))), 300)
    assert judgement.status == "ambiguous"
    assert "35.0 mm" in judgement.reason or "34.9 mm" in judgement.reason or "35.1 mm" in judgement.reason
    assert "repeats" in judgement.reason


def test_a_weak_second_transform_does_not_make_ambiguous():
    assert judge(((80, T_TRUE), (15, T_TRUE @ exp_se3([0, 0, 0, 35, 0, 0]))), 300).status == "accepted"


def test_a_match_stands_still_if_its_pixel_does_not_move():
    matches = matched.pair(np.random.default_rng(0), 20)[2]
    matches.pixels_b[:5] = matches.pixels_a[:5] + 1.0
    still = standing_still(matches, 2.0)
    assert still[:5].all()
    assert not still[5:].any()


def test_a_sensor_is_known_by_its_camera():
    a, b = sheets.quiet("a"), sheets.quiet("b")
    assert same_sensor(a, b)


@pytest.fixture(scope="module")
def refined():
    found = refine_pair(*sheets.pair(), sheets.T_TRUE)
    return found, observability(found, noise_covariance(found))


def test_a_good_refinement_is_confirmed(refined):
    assert judge_refined(*refined, 0.2, OPTIONS) is None


def test_surfaces_that_do_not_overlap_are_refused():
    judgement = judge_refined(None, (), 0.0, OPTIONS)
    assert judgement.status == "refused"
    assert "do not overlap" in judgement.reason


def test_a_refinement_that_leaves_the_consensus_is_refused(refined):
    judgement = judge_refined(*refined, 2.0, OPTIONS)
    assert judgement.status == "refused"
    assert "left the consensus by 2.00 mm" in judgement.reason


def test_a_direction_that_nothing_holds_is_refused(refined):
    found, directions = refined
    loose = Direction(directions[0].direction, 100.0, 7.5, 0.1, False)
    judgement = judge_refined(found, (*directions[:5], loose), 0.1, OPTIONS)
    assert judgement.status == "refused"
    assert "1 direction(s)" in judgement.reason
    assert "7.5 mm" in judgement.reason


def test_textures_that_do_not_correlate_are_refused(refined):
    found, directions = refined
    assert found.equations.correlation > 0.9
    a, b = sheets.pair()
    view = b.measurement.views["A"]
    other = replace(b.measurement, views={"A": replace(view, mean=np.ascontiguousarray(view.mean[:, ::-1]))})
    judgement = judge_refined(refine_pair(a, prepare(other, sheets.PITCH_MM), sheets.T_TRUE), directions, 0.1, OPTIONS)
    assert judgement.status == "refused"
    assert "do not correlate" in judgement.reason


def test_surfaces_that_pierce_each_other_are_refused(refined):
    found, directions = refined
    e = found.equations
    piercing = replace(found, equations=replace(e, conflicts=e.points))
    judgement = judge_refined(piercing, directions, 0.1, OPTIONS)
    assert judgement.status == "refused"
    assert "50 % of the overlap the surfaces pierce" in judgement.reason
