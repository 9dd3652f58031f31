"""Row errors of pixel pairs: derivatives, orientation, significance, covariance, lenses, outliers; without images."""

from dataclasses import replace

import numpy as np
import pytest

from pixel_pairs import pairs_of
from planish.rig.derivatives import project_with_derivatives
from planish.rig.parameters import DEVICE_PARAMETERS, selection
from planish.sensing.rigcheck.adjust import adjust_orientation
from planish.sensing.rigcheck.check import evidence_of, usable
from planish.sensing.rigcheck.estimates import estimate_orientation, slow_pattern, unexplained
from planish.sensing.rigcheck.orientation import (
    CHANGES,
    external_names,
    orientation_basis,
    reoriented,
    without_baseline_length,
)
from planish.sensing.rigcheck.pairs import row_error_derivatives, row_errors
from planish.simulation.sensor import reference_rig

RIG = replace(reference_rig(0.5), projector=None)
#: Central differences of double precision at steps of 1e-6 of a parameter's effect.
DERIVATIVE_TOLERANCE = 1e-5
#: Mean of NEES / 5 over SEEDS draws lies within four of its standard deviations, sqrt(2 / (5 SEEDS)), of 1.
SEEDS, NEES_BAND = 24, 4 * np.sqrt(2 / 120)


def off_by(k, degrees, rig=RIG, moved="B", fixed="A"):
    return reoriented(rig, moved, fixed, orientation_basis(rig, moved, fixed)[:, k] * np.deg2rad(degrees))


def with_covariance(rig, rng, noise_px=0.05):
    """A rig that states the covariance of a calibration by known points."""
    free = ("fx", "fy", "cx", "cy", "k1")
    names = [f"{device}.{name}" for device in "AB" for name in free] + list(external_names("B"))
    points = rng.uniform(-1, 1, (300, 3)) * (200, 150, 100)
    picks = selection(names, tuple(rig.devices))
    rows = [project_with_derivatives(rig.cameras[name], points)[2] @ picks[name] for name in "AB"]
    J = np.concatenate(rows).reshape(-1, len(names)) / noise_px
    return replace(rig, covariance=np.linalg.inv(J.T @ J), covariance_parameters=tuple(names))


@pytest.mark.parametrize(("own", "other"), [("A", "B"), ("B", "A"), ("A", "projector")])
def test_derivatives_of_row_errors_are_those_of_differences(own, other):
    rig = reference_rig(0.5)
    pairs = pairs_of(off_by(0, 0.1), np.random.default_rng(0), 30) if other != "projector" else None
    pairs = pairs or pairs_of(rig, np.random.default_rng(0), 30, other=other)
    if own == "B":
        pairs = pairs_of(rig, np.random.default_rng(0), 30, own="B", other="A")
    names = [f"{device}.{name}" for device in (own, other) for name in DEVICE_PARAMETERS]
    rows = row_errors(pairs, rig)
    found = row_error_derivatives(rig, pairs, rows, names)
    for k, name in enumerate(names):
        step = 1e-5 / max(np.abs(found[:, k]).max(), 1e-3)
        change = np.eye(len(names))[k] * step
        more, less = (row_errors(pairs, rig.changed(sign * change, names)).error_px for sign in (1, -1))
        # The error falls as the line moves towards the point.
        assert (less - more) / (2 * step) == pytest.approx(
            found[:, k], abs=DERIVATIVE_TOLERANCE * max(np.abs(found[:, k]).max(), 1)
        ), name


def test_pairs_of_the_true_rig_have_no_row_error():
    rows = row_errors(pairs_of(RIG, np.random.default_rng(0), sigma_px=0.0), RIG)
    assert np.abs(rows.error_px).max() < 1e-6


@pytest.mark.parametrize("k", range(5))
def test_another_orientation_keeps_the_baseline_as_long(k):
    changed = off_by(k, 0.5)
    lengths = [np.linalg.norm(r.cameras["B"].center_sensor - r.cameras["A"].center_sensor) for r in (RIG, changed)]
    assert lengths[0] == pytest.approx(lengths[1], abs=1e-9)
    assert np.array_equal(changed.cameras["A"].T_camera_sensor, RIG.cameras["A"].T_camera_sensor)
    assert without_baseline_length(RIG, "B", "A") @ orientation_basis(RIG, "B", "A") == pytest.approx(
        orientation_basis(RIG, "B", "A")
    )


@pytest.mark.parametrize("k", range(5))
@pytest.mark.parametrize("degrees", [-0.3, 0.3])
def test_a_changed_orientation_is_found_and_undone(k, degrees):
    pairs = pairs_of(off_by(k, degrees), np.random.default_rng(k))
    adjustment = adjust_orientation([pairs], RIG)
    truth = np.deg2rad(degrees) * np.eye(5)[k]
    assert adjustment.refusal == ""
    assert np.abs(adjustment.change_rad - truth).max() < 0.3 * np.deg2rad(0.3)
    assert (np.abs(adjustment.change_rad - truth) < 4 * adjustment.sigma_rad).all()
    assert slow_pattern(evidence_of([pairs], adjustment.rig)).rms_px < 0.02


def test_the_covariance_after_adjusting_is_that_of_the_errors():
    """Changes drawn from the size that the prior knows nothing of; NEES of all five together."""
    rng, nees = np.random.default_rng(1), []
    for _ in range(SEEDS):
        truth = np.deg2rad(0.1) * rng.standard_normal(5)
        true = reoriented(RIG, "B", "A", orientation_basis(RIG, "B", "A") @ truth)
        adjustment = adjust_orientation([pairs_of(true, rng, 150)], RIG)
        places = [adjustment.rig.covariance_parameters.index(name) for name in external_names("B")]
        back = np.linalg.pinv(orientation_basis(RIG, "B", "A"))
        covariance = back @ adjustment.rig.covariance[np.ix_(places, places)] @ back.T
        error = adjustment.change_rad - truth
        nees.append(error @ np.linalg.solve(covariance, error) / 5)
    # What the check itself may be wrong by (FLOOR_PX) is no error of these pairs: the covariance may be larger.
    assert 0.5 < np.mean(nees) < 1 + NEES_BAND


def test_an_intact_rig_is_significant_as_seldom_as_chance_has_it():
    rng = np.random.default_rng(2)
    sigmas = []
    for _ in range(SEEDS):
        evidence = evidence_of([pairs_of(RIG, rng, 150)], RIG)
        sigmas.append(max(estimate_orientation(evidence, None).sigmas, unexplained(evidence, None)[1]))
    assert max(sigmas) < 4
    assert np.median(sigmas) < 1.2


def test_an_intact_rig_is_not_adjusted():
    adjustment = adjust_orientation([pairs_of(RIG, np.random.default_rng(3))], RIG)
    assert adjustment.size_rad == 0
    assert adjustment.rig is RIG


def test_rigs_drawn_from_the_covariance_they_state_hold_and_knocked_ones_do_not():
    rng = np.random.default_rng(4)
    stated = with_covariance(RIG, rng)
    modes = stated.modes()
    for _ in range(30):
        rig = stated.changed(rng.standard_normal(len(modes)) @ modes)
        assert estimate_orientation(evidence_of([pairs_of(RIG, rng, sigma_px=0.02)], rig), rig).sigmas < 4
    knocked = off_by(0, 0.02, stated)
    assert estimate_orientation(evidence_of([pairs_of(RIG, rng, sigma_px=0.02)], knocked), knocked).sigmas > 8


def test_adjusting_takes_from_the_covariance_what_row_errors_tell_and_leaves_the_baselines_length():
    rng = np.random.default_rng(5)
    stated = with_covariance(RIG, rng, noise_px=0.5)
    after = adjust_orientation([pairs_of(RIG, rng, sigma_px=0.02)], stated).rig
    assert after.covariance_parameters == stated.covariance_parameters
    assert np.linalg.eigvalsh(after.covariance).min() > -1e-12 * np.abs(after.covariance).max()
    evidence = evidence_of([pairs_of(RIG, rng, sigma_px=0.02)], stated)
    allowed = [np.sqrt(((evidence.by_rig @ rig.modes().T) ** 2).sum(1).mean()) for rig in (stated, after)]
    # The part that the lenses' covariance makes stays.
    assert allowed[1] < 0.8 * allowed[0]
    places = [stated.covariance_parameters.index(f"B.translation_{axis}") for axis in "xyz"]
    T = RIG.cameras["B"].T_camera_sensor @ np.linalg.inv(RIG.cameras["A"].T_camera_sensor)
    t = T[:3, 3] / np.linalg.norm(T[:3, 3])
    length = [np.sqrt(t @ rig.covariance[np.ix_(places, places)] @ t) for rig in (stated, after)]
    assert length[1] == pytest.approx(length[0], rel=1e-6)


def test_intrinsics_stay_as_they_are():
    rng = np.random.default_rng(6)
    stated = with_covariance(RIG, rng)
    after = adjust_orientation([pairs_of(off_by(0, 0.2), rng)], stated).rig
    for name in "AB":
        assert np.array_equal(after.cameras[name].K, stated.cameras[name].K)
        assert np.array_equal(after.cameras[name].distortion, stated.cameras[name].distortion)


def wrong_lens(factor, k1=0.0):
    camera = RIG.cameras["B"]
    K, distortion = camera.K.copy(), camera.distortion.copy()
    K[1, 1] *= factor
    distortion[0] += k1
    return replace(RIG, cameras={**RIG.cameras, "B": replace(camera, K=K, distortion=distortion)})


def test_an_error_of_the_lens_is_told_from_one_of_the_orientation():
    pairs = pairs_of(wrong_lens(1.0, 0.5), np.random.default_rng(7))
    left_px, sigmas = unexplained(evidence_of([pairs], RIG), None)
    assert left_px > 0.1
    assert sigmas > 6


def test_row_errors_by_a_badly_wrong_lens_are_not_adjusted():
    adjustment = adjust_orientation([pairs_of(wrong_lens(1.0, 3.0), np.random.default_rng(8))], RIG)
    assert "none that an orientation makes" in adjustment.refusal
    assert adjustment.rig is RIG


def test_a_third_of_outliers_changes_nothing():
    rng = np.random.default_rng(9)
    pairs = pairs_of(off_by(1, 0.1), rng)
    wrong = rng.choice(len(pairs), len(pairs) // 3, replace=False)
    there = pairs.other_px.copy()
    there[wrong] += rng.uniform(-20, 20, (len(wrong), 2))
    adjustment = adjust_orientation([pairs.with_other(there)], RIG)
    assert adjustment.change_rad[1] == pytest.approx(np.deg2rad(0.1), abs=np.deg2rad(0.01))


def test_at_one_distance_the_turn_and_the_offset_are_not_told_apart_but_their_row_error_vanishes():
    pairs = pairs_of(off_by(0, 0.2), np.random.default_rng(10), depth_mm=0.5)
    adjustment = adjust_orientation([pairs], RIG)
    turn, offset = CHANGES.index("turn about the baseline"), CHANGES.index("offset across")
    assert adjustment.sigma_rad[[turn, offset]].min() > np.deg2rad(0.01)
    assert slow_pattern(evidence_of([pairs], adjustment.rig)).rms_px < 0.02


def test_a_moved_projector_is_found_against_its_camera():
    rig = reference_rig(0.5)
    true = off_by(0, 0.2, rig, "projector", "A")
    pairs = pairs_of(true, np.random.default_rng(11), other="projector")
    adjustment = adjust_orientation([pairs], rig)
    assert slow_pattern(evidence_of([pairs], adjustment.rig)).rms_px < 0.02
    for name in "AB":
        assert np.array_equal(adjustment.rig.cameras[name].T_camera_sensor, rig.cameras[name].T_camera_sensor)


def test_pairs_of_other_devices_do_not_mix():
    rng, rig = np.random.default_rng(12), reference_rig(0.5)
    many, few = pairs_of(rig, rng, 50), pairs_of(rig, rng, 20, other="projector")
    assert usable({"a": many, "b": few}) == [many]
    assert usable({"c": pairs_of(rig, rng, 5)}) == []
