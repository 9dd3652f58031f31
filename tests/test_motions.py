"""Repeating prints, backgrounds, sensor patterns: what agrees must belong to the part, and to one motion alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import motions
from motions import T_MOVED
from planish.geometry import exp_se3
from planish.registration.verdict.verify import correlate_windows

STILL = np.eye(4)
#: Columns of the image that show a background.
BACKGROUND = np.s_[: motions.SIZE_PX[0] * 3 // 10]
#: A right transform, refined, anywhere on b [mm].
RIGHT_MM = 0.1
#: A period found by correlation is good to a pixel of the texture image [mm].
PERIOD_MM = 2.0


@cache
def moved_grain():
    return motions.measured(STILL, motions.grain(), "a", 1), motions.measured(T_MOVED, motions.grain(), "b", 2)


@cache
def static_background():
    other = motions.grain(0.03, 9)
    a, b = moved_grain()
    return (
        motions.composed(a, motions.measured(STILL, other, "a", 3), BACKGROUND),
        motions.composed(b, motions.measured(STILL, other, "b", 4), BACKGROUND),
    )


def test_unique_grain_is_accepted_and_right():
    result = motions.registered(*moved_grain())
    assert result.status == "accepted"
    assert motions.worst_mm(result.T_a_b, T_MOVED, moved_grain()[1]) < RIGHT_MM
    assert result.windows_agreeing > 0.9 * result.windows > 50
    assert result.motions == ()


def test_windows_agree_where_the_transform_is_right_and_by_chance_where_it_is_not():
    a, b = (motions.side(m) for m in moved_grain())
    verify = motions.options().verdict.verify
    right = correlate_windows(a, b, T_MOVED, verify)
    wrong = correlate_windows(a, b, exp_se3([0, 0, 0, 25, -40, 0]) @ T_MOVED, verify)
    assert right.agrees.all()
    assert len(wrong) > 80
    # Four standard deviations of a binomial number.
    expected = wrong.chance * len(wrong)
    assert wrong.agrees.sum() < expected + 4 * np.sqrt(expected)
    assert np.median(wrong.score) < 0.3 * np.median(right.score)


def test_screened_windows_are_some_of_all():
    a, b = (motions.side(m) for m in moved_grain())
    verify = motions.options().verdict.verify
    everything, some = (correlate_windows(a, b, T_MOVED, verify, every) for every in (1, 2))
    assert 0.15 * len(everything) < len(some) < 0.35 * len(everything)
    assert np.isin(some.cell, everything.cell).all()
    assert some.agrees.all()


@pytest.mark.parametrize(("texture", "period_mm"), [(motions.chessboard, 28.0), (motions.repeating, 36.0)])
def test_a_pattern_that_repeats_is_ambiguous_and_its_period_named(texture, period_mm):
    result = motions.registered(
        motions.measured(STILL, texture(), "a", 1), motions.measured(T_MOVED, texture(), "b", 2)
    )
    assert result.status == "ambiguous"
    assert "repeats after" in result.reason
    # A chessboard repeats along the diagonals of its squares, too.
    nearest = (period_mm, period_mm / np.sqrt(2))
    assert min(abs(result.runner_up.translation_mm - p) for p in nearest) < PERIOD_MM


def test_a_texture_that_looks_the_same_after_half_a_turn_is_ambiguous():
    texture = motions.half_turn()
    result = motions.registered(motions.measured(STILL, texture, "a", 1), motions.measured(T_MOVED, texture, "b", 2))
    assert result.status == "ambiguous"
    assert "turned by 180 deg it looks the same" in result.reason
    assert np.rad2deg(result.runner_up.rotation_rad) == pytest.approx(180, abs=1)


def test_the_sensors_own_pattern_is_never_taken_for_the_part():
    pattern = motions.sensor_pattern()
    a = motions.measured(STILL, motions.even(), "a", 1, prnu=pattern)
    b = motions.measured(T_MOVED, motions.even(), "b", 2, prnu=pattern)
    result = motions.registered(a, b)
    assert result.status == "refused"
    assert "stands still" in result.reason


def test_grain_wins_over_the_sensors_pattern_on_top_of_it():
    pattern = motions.sensor_pattern()
    a = motions.measured(STILL, motions.grain(), "a", 1, prnu=pattern)
    b = motions.measured(T_MOVED, motions.grain(), "b", 2, prnu=pattern)
    result = motions.registered(a, b)
    assert result.status == "accepted"
    assert motions.worst_mm(result.T_a_b, T_MOVED, b) < RIGHT_MM


def test_a_plate_that_was_not_moved_is_refused_because_a_plane_slides_unseen():
    a, _ = moved_grain()
    result = motions.registered(a, motions.measured(STILL, motions.grain(), "b", 2))
    assert result.status == "refused"
    assert "was not moved" in result.reason


def test_a_part_with_relief_that_was_not_moved_is_accepted_because_its_surface_alone_proves_it():
    one, again = (motions.embossed(motions.measured(STILL, motions.grain(), name, i)) for i, name in enumerate("ab"))
    result = motions.registered(one, again)
    assert result.status == "accepted"
    assert motions.worst_mm(result.T_a_b, STILL, again) < RIGHT_MM


def test_a_background_that_stands_still_is_named_left_out_and_never_the_part():
    a, b = static_background()
    result = motions.registered(a, b)
    assert result.status == "accepted"
    assert motions.worst_mm(result.T_a_b, T_MOVED, b) < RIGHT_MM
    assert "stood still" in result.reason
    part, background = result.motions
    assert (part.stands_still, background.stands_still) == (False, True)
    assert background.box_b_px[2] < BACKGROUND.stop + motions.window_px()


def test_a_blank_part_before_a_background_that_stands_still_is_refused():
    other = motions.grain(0.03, 9)
    a = motions.composed(
        motions.measured(STILL, motions.even(), "a", 1), motions.measured(STILL, other, "a", 3), BACKGROUND
    )
    b = motions.composed(
        motions.measured(T_MOVED, motions.even(), "b", 2), motions.measured(STILL, other, "b", 4), BACKGROUND
    )
    result = motions.registered(a, b)
    assert result.status == "refused"
    assert "stands still" in result.reason


def test_two_things_that_moved_differently_are_both_reported_and_the_pair_is_ambiguous():
    T_other, half = exp_se3([0, 0, -0.2, -20, 30, 0]), np.s_[: motions.SIZE_PX[0] * 4 // 10]
    other = motions.grain(0.03, 9)
    a, b = moved_grain()
    a = motions.composed(a, motions.measured(STILL, other, "a", 3), half)
    b = motions.composed(b, motions.measured(T_other, other, "b", 4), half)
    result = motions.registered(a, b)
    assert result.status == "ambiguous"
    assert "two things moved differently" in result.reason
    assert len(result.motions) == 2
    # Before refinement: a coarse transform is good to a window's tolerance.
    worst = [[motions.worst_mm(m.T_a_b, T, b) for T in (T_MOVED, T_other)] for m in result.motions]
    assert sorted(np.argmin(worst, axis=1)) == [0, 1]
    assert np.min(worst, axis=1).max() < motions.agree_mm()
