"""The verdict: what chance explains is refused, what stands still is refused, what repeats is ambiguous."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from math import comb, log10

import numpy as np
import pytest

import matched
import sheets
from planish.geometry import exp_se3, transform_points
from planish.measurement import Finding
from planish.registration.consensus import Candidate, CoarseResult, Search, find_consensus
from planish.registration.pair import refine_pair, residual_statistics
from planish.registration.prepared import prepare
from planish.registration.refine.covariance import noise_covariance, observability
from planish.registration.result import Direction
from planish.registration.texture.photometric import local_contrast
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.false_alarms import (
    chance_of_agreement,
    dispersion,
    log10_by_matches,
    log10_by_windows,
    log10_false_alarms,
    log10_of_product,
)
from planish.registration.verdict.geometry import Sight, line_of_sight
from planish.registration.verdict.hypothesis import Drift
from planish.registration.verdict.judge import VerdictOptions, judge_coarse, judge_refined
from planish.registration.verdict.reasons import already_found
from planish.registration.verdict.still import geometry_stands_still, same_sensor, standing_still
from planish.registration.verdict.together import Together
from planish.registration.verdict.verify import Windows

#: Accuracy of the incomplete beta function, as a logarithm.
LOG_TOLERANCE = 1e-6
OPTIONS = VerdictOptions()
#: Surfaces that hide nothing.
CLEAR = Sight(meet=1000, hidden=0)


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


def judge(groups, total, still=0, pairs=1, seed=0):
    """Verdict of matches alone: measurements whose charts hold no texture; the first `still` matches do not move."""
    matches = matched.pair(np.random.default_rng(seed), total, groups)[2]
    matches.pixels_b[:still] = matches.pixels_a[:still]
    sides = (Side(m, (), local_contrast(m)) for m in map(sheets.quiet, "ab"))
    return judge_coarse(*sides, matches, find_consensus(matches), pairs, OPTIONS)


def test_a_consensus_far_above_chance_is_accepted():
    verdict = judge(((40, sheets.T_TRUE),), 300)
    assert verdict.judgement.status == "accepted"
    assert verdict.log10_false_alarms < -20
    assert "matched places" in verdict.judgement.reason


def test_a_refusal_says_what_measuring_warned_of():
    said = [Finding("movement", 0.3, 0.1, "px", "", "it moved"), Finding("coverage", 80.0, None, "%", "")]
    a, b = (replace(sheets.quiet(side), findings=tuple(said[:k])) for side, k in (("a", 2), ("b", 0)))
    assert already_found(a, b) == "; but mend first what measuring found in a: it moved"
    assert already_found(b, b) == ""


def test_random_matches_are_refused_as_chance():
    verdict = judge(((4, sheets.T_TRUE),), 300)
    assert verdict.judgement.status == "refused"
    assert "which chance explains" in verdict.judgement.reason


def test_the_pairs_of_the_run_count():
    one, many = (judge(((7, sheets.T_TRUE),), 60, pairs=n) for n in (1, 10**12))
    assert (one.judgement.status, many.judgement.status) == ("accepted", "refused")
    assert many.log10_false_alarms == pytest.approx(one.log10_false_alarms + 12)


@pytest.mark.parametrize("total", [0, 2, 30])
def test_where_no_three_places_agree_the_pair_is_refused(total):
    verdict = judge((), total, seed=3)
    assert verdict.judgement.status == "refused"
    assert "no consensus" in verdict.judgement.reason
    assert verdict.first is None


def test_what_stands_still_in_the_image_waits_for_the_surfaces():
    verdict = judge(((40, sheets.T_TRUE),), 300, still=40)
    assert verdict.unmoved
    assert verdict.judgement.reason.startswith("nothing moved")


def test_what_moves_is_found_behind_what_stands_still():
    other = sheets.T_TRUE @ exp_se3([0, 0, 0, 35, 0, 0])
    verdict = judge(((60, other), (30, sheets.T_TRUE)), 300, still=60)
    assert verdict.judgement.status == "accepted"
    assert not verdict.unmoved
    assert np.abs(verdict.first.T_a_b - sheets.T_TRUE).max() < 0.5
    assert [motion.stands_still for motion in verdict.motions] == [False, True]


def test_two_transforms_with_much_support_are_ambiguous():
    verdict = judge(((60, sheets.T_TRUE), (50, sheets.T_TRUE @ exp_se3([0, 0, 0, 35, 0, 0]))), 300)
    assert verdict.judgement.status == "ambiguous"
    assert verdict.runner_up.translation_mm == pytest.approx(35, abs=0.2)
    assert f"{verdict.runner_up.translation_mm:.1f} mm" in verdict.judgement.reason
    assert len(verdict.motions) == 2


def test_a_weak_second_transform_does_not_make_ambiguous():
    verdict = judge(((80, sheets.T_TRUE), (15, sheets.T_TRUE @ exp_se3([0, 0, 0, 35, 0, 0]))), 300)
    assert verdict.judgement.status == "accepted"


def test_a_match_that_shares_its_direction_with_all_others_agrees_more_easily():
    rng = np.random.default_rng(2)
    matches = matched.pair(rng, 400)[2]
    brushed = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (400, 3, 3))
    coarse = CoarseResult((), 1e-12, 400)
    any_direction = chance_of_agreement(matches, np.eye(4), coarse)
    one_direction = chance_of_agreement(replace(matches, frames_a=brushed, frames_b=brushed), np.eye(4), coarse)
    # Orientations agree within an angle out of pi; the normals of both agree.
    assert one_direction / any_direction == pytest.approx(np.pi / coarse.options.frame_angle_rad, rel=0.3)
    # Places spread over 300 x 250 mm (the root of this area is the places' own), 1.5 mm around each.
    assert one_direction == pytest.approx(np.pi * 1.5**2 / (300 * 250), rel=0.2)


def alarms_by_matches(points_of_members_mm, seed=0):
    """False alarms of twelve matches that agree at these places of b, among 300."""
    matches = matched.pair(np.random.default_rng(seed), 300, ((12, sheets.T_TRUE),))[2]
    matches.points_b[:12, :2] = points_of_members_mm
    matches.points_a[:12] = transform_points(sheets.T_TRUE, matches.points_b[:12])
    coarse = find_consensus(matches, search=Search(looked_at_mm=6.0))
    return log10_by_matches(matches, Candidate(sheets.T_TRUE, np.arange(12), 12), coarse)


def test_matches_on_one_piece_of_texture_are_one_coincidence():
    rng = np.random.default_rng(1)
    assert alarms_by_matches(rng.uniform(-120, 120, (12, 2))) < -10
    # All within the 6 mm that each of them has compared.
    assert alarms_by_matches(rng.uniform(-4, 4, (12, 2))) > 0


def test_matches_that_lie_on_a_line_because_rims_match_rims_prove_less():
    rng = np.random.default_rng(1)
    matches = matched.pair(rng, 300, ((40, sheets.T_TRUE),))[2]
    # Forty matches between two rims; along them, only some agree.
    along = np.linspace(-120, 120, 40)
    matches.points_b[:40] = np.column_stack([along, np.full(40, 100.0), np.zeros(40)])
    slid = np.where(np.arange(40) % 5 == 0, 0.0, rng.uniform(-15, 15, 40))
    moved = matches.points_b[:40] + np.column_stack([slid, np.zeros((40, 2))])
    matches.points_a[:40] = transform_points(sheets.T_TRUE, moved)
    coarse = find_consensus(matches, search=Search(looked_at_mm=1.0))
    members = np.arange(0, 40, 5)
    on_a_line = log10_by_matches(matches, Candidate(sheets.T_TRUE, members, len(members)), coarse)
    among_all = log10_false_alarms(8, coarse.places, chance_of_agreement(matches, sheets.T_TRUE, coarse), 1)
    assert among_all < -10
    assert on_a_line > among_all / 2


def test_two_independent_chances_multiply_as_uniform_ones_do():
    rng = np.random.default_rng(0)
    product = np.log10(rng.uniform(size=(20000, 2))).sum(1)
    for log10_limit in (-1.0, -2.0):
        share = np.mean([log10_of_product(p, 0.0) <= log10_limit for p in product])
        assert share == pytest.approx(10**log10_limit, rel=0.15)


def test_windows_whose_peaks_cluster_count_less():
    rng = np.random.default_rng(0)
    n, chance = 400, 0.05
    agrees = np.arange(n) < 60
    spread = windows(np.where(agrees[:, None], 0.0, rng.uniform(-4, 4, (n, 2))), agrees, chance)
    # Forty lines of ten windows each, every line with one peak.
    lines = np.repeat(rng.uniform(-4, 4, (n // 10, 2)), 10, axis=0)
    clustered = windows(np.where(agrees[:, None], 0.0, lines), agrees, chance)
    assert dispersion(spread) == 1.0
    assert 4 < dispersion(clustered) < 20
    assert log10_by_windows(spread) < 3 * log10_by_windows(clustered)


def windows(offset_mm, agrees, chance):
    n = len(agrees)
    flat, points, pixels = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 2))
    nothing = Together(np.empty((n, 0)), np.empty((n, 0)), np.empty(0, bool))
    return Windows(np.arange(n), points, pixels, pixels, pixels, offset_mm, flat, agrees, chance, flat, nothing)


#: Search area of the surfaces made below [px], and the places of it that agree.
REACH = 8
NEAR = (np.hypot(*np.indices((2 * REACH + 1,) * 2) - REACH) <= 2).ravel()


def surfaces(rng, n):
    return rng.standard_normal((n, 2 * REACH + 1, 2 * REACH + 1))


def test_chance_of_the_summed_windows_is_no_smaller_than_it_says():
    rng = np.random.default_rng(0)
    tails = [Together.of(surfaces(rng, 30) ** 3, surfaces(rng, 30), NEAR).log10_chance() for _ in range(500)]
    for k in (0.5, 1.0, 1.5):
        assert np.mean(np.array(tails) <= -k) <= 10**-k


def test_windows_too_weak_to_peak_at_their_place_tell_it_together():
    rng = np.random.default_rng(0)
    surface = surfaces(rng, 150)
    surface[:, REACH, REACH] += 1.0
    peaks = surface.reshape(150, -1).argmax(1)
    assert NEAR[peaks].mean() < 0.15
    assert Together.of(surface, surfaces(rng, 150), NEAR).log10_chance() < -20


def test_a_sum_that_is_higher_elsewhere_speaks_for_nothing():
    rng = np.random.default_rng(0)
    surface = surfaces(rng, 150)
    surface[:, REACH, REACH] += 1.0
    surface[:, REACH, 0] += 2.0
    assert Together.of(surface, surfaces(rng, 150), NEAR).log10_chance() == 0.0


def test_few_windows_with_texture_tell_it_among_many_without():
    rng = np.random.default_rng(0)
    surface, agrees = surfaces(rng, 200), np.zeros(200, bool)
    surface[::8, REACH, REACH] += 2.0
    together = Together.of(surface, surfaces(rng, 200), NEAR)
    even = replace(windows(rng.uniform(-4, 4, (200, 2)), agrees, 0.05), together=together)
    richest = replace(even, richness=np.where(np.arange(200) % 8 == 0, 1.2, 1.0))
    assert log10_by_windows(richest) < log10_by_windows(even) - 5


def test_windows_that_are_alike_count_less_together():
    rng = np.random.default_rng(0)
    surface, unrelated = surfaces(rng, 150), surfaces(rng, 150)
    surface[:, REACH, REACH] += 1.0
    # Ten windows on each of fifteen lines.
    alike = np.repeat(unrelated[:15], 10, axis=0)
    independent, clustered = (Together.of(surface, other, NEAR).log10_chance() for other in (unrelated, alike))
    assert independent < 5 * clustered


def test_surfaces_of_one_part_do_not_hide_each_other():
    a, b = sheets.quiet("a"), sheets.quiet("b")
    sight = line_of_sight(a, b, sheets.T_TRUE, 1.0)
    assert sight.meet > 500
    assert sight.conflict < 0.01


@pytest.mark.parametrize("lift_mm", [-12.0, 12.0])
def test_a_surface_before_what_the_other_camera_saw_contradicts(lift_mm):
    a, b = sheets.quiet("a"), sheets.quiet("b")
    # Whether b is lifted off a or pushed behind it: one of the cameras sees the contradiction.
    lifted = exp_se3([0, 0, 0, 0, 0, lift_mm]) @ sheets.T_TRUE
    assert line_of_sight(a, b, lifted, 1.0).conflict > 0.9


def test_a_transform_that_hides_one_surface_behind_the_other_is_refused():
    verdict = judge(((40, exp_se3([0, 0, 0, 0, 0, 12]) @ sheets.T_TRUE),), 300)
    assert verdict.judgement.status == "refused"
    assert "geometry contradicts the texture" in verdict.judgement.reason


def test_only_surfaces_that_every_motion_parts_prove_that_nothing_moved():
    plate, bent = (refine_pair(*sheets.pair(bend=bend), sheets.T_TRUE) for bend in (0.0, sheets.ROUND))
    assert geometry_stands_still(bent, 2 * sheets.GSD_MM)
    assert not geometry_stands_still(plate, 100 * sheets.GSD_MM)


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
    assert judge_refined(*refined, Drift(0.2), CLEAR, OPTIONS) is None


def test_surfaces_that_do_not_overlap_are_refused():
    judgement = judge_refined(None, (), Drift(0.0), CLEAR, OPTIONS)
    assert judgement.status == "refused"
    assert "do not overlap" in judgement.reason


def test_a_refinement_that_leaves_the_consensus_is_refused(refined):
    judgement = judge_refined(*refined, Drift(2.0), CLEAR, OPTIONS)
    assert judgement.status == "refused"
    assert "left the consensus by 2.00 mm" in judgement.reason


def test_a_direction_that_nothing_holds_is_refused(refined):
    found, directions = refined
    loose = Direction(directions[0].direction, 100.0, 7.5, 0.1, False, "a shift along the overlap's length")
    judgement = judge_refined(found, (*directions[:5], loose), Drift(0.1), CLEAR, OPTIONS)
    assert judgement.status == "refused"
    assert "1 direction(s) held by neither" in judgement.reason
    assert "uncertain by" in judgement.reason
    assert "7.5 mm" in judgement.reason


def test_textures_that_do_not_correlate_are_refused(refined):
    found, directions = refined
    assert found.equations.correlation > 0.9
    a, b = sheets.pair()
    view = b.measurement.views["A"]
    other = replace(b.measurement, views={"A": replace(view, mean=np.ascontiguousarray(view.mean[:, ::-1]))})
    b = prepare(other, sheets.PITCH_MM)
    found = refine_pair(a, b, sheets.T_TRUE)
    fit = residual_statistics(a, b, found)
    judgement = judge_refined(found, directions, Drift(0.1), CLEAR, OPTIONS, fit=fit)
    assert judgement.status == "refused"
    assert "do not correlate" in judgement.reason


def test_surfaces_that_hide_one_another_are_refused(refined):
    judgement = judge_refined(*refined, Drift(0.1), Sight(meet=500, hidden=500), OPTIONS)
    assert judgement.status == "refused"
    assert "50 % of the overlap the surfaces hide one another" in judgement.reason
