"""Consensus: the right transform among many wrong matches, and none where there is none."""

from __future__ import annotations

import numpy as np
import pytest

import matched
from matched import T_TRUE
from planish import _core
from planish.geometry import exp_se3, exp_so3, rotation_angle, transform_points
from planish.registration.consensus import ConsensusOptions, count_places, find_consensus
from planish.registration.verdict.false_alarms import log10_false_alarms
from reference import consensus as reference

#: A rigid fit to 15 places of 0.2 mm noise over 300 mm, with a tolerance of 1 mm that may let one wrong match in.
TRANSFORM_TOLERANCE_MM = 0.8


def arrays(m):
    return m.points_a, m.points_b, m.frames_a, m.frames_b


def worst_error_mm(T, points_b):
    return np.linalg.norm(transform_points(T, points_b) - transform_points(T_TRUE, points_b), axis=1).max()


def brushed(rng, n):
    return matched.plate_side(rng, n, directions=(0.1, 0.1 + np.pi))


@pytest.mark.parametrize("side", [matched.random_side, matched.plate_side, brushed])
@pytest.mark.parametrize("seed", range(8))
def test_three_percent_of_right_matches_among_500_give_the_right_transform(seed, side):
    rng = np.random.default_rng(seed)
    _, b, matches = matched.pair(rng, 500, ((15, T_TRUE),), side=side)
    found = find_consensus(matched.shuffled(rng, matches))
    best = found.candidates[0]
    assert worst_error_mm(best.T_a_b, b.points_sensor) < TRANSFORM_TOLERANCE_MM
    assert best.places >= 13
    assert log10_false_alarms(best.places, found.places, found.chance, 1) < -5


@pytest.mark.parametrize("seed", range(4))
def test_orientations_as_poor_as_those_of_descriptors_alone_do_with_a_wider_limit(seed):
    rng = np.random.default_rng(seed)
    _, b, matches = matched.pair(rng, 500, ((15, T_TRUE),), turn_rad=0.1, side=matched.plate_side)
    best = find_consensus(matched.shuffled(rng, matches), ConsensusOptions(frame_angle_rad=0.35)).candidates[0]
    assert worst_error_mm(best.T_a_b, b.points_sensor) < TRANSFORM_TOLERANCE_MM


def test_matches_of_several_sides_of_a_round_part_agree_on_one_transform():
    rng = np.random.default_rng(1)
    around = [exp_so3([angle, 0, 0]) for angle in rng.uniform(-1.2, 1.2, 30)]
    facing = matched.frames(rng, 30)
    points = np.array([R @ [x, 0, -75.0] for R, x in zip(around, rng.uniform(-100, 100, 30), strict=True)])
    b = matched.keypoints(points, np.array([R @ f for R, f in zip(around, facing, strict=True)]), rng)
    a = matched.keypoints(transform_points(T_TRUE, points), T_TRUE[:3, :3] @ b.frames_sensor, rng)
    wrong = matched.pair(rng, 300)[2]
    parts = [matched.matches_of(a, b), wrong]
    names = wrong.__dataclass_fields__
    best = find_consensus(type(wrong)(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))).candidates[0]
    assert set(range(30)) <= set(best.members)


@pytest.mark.parametrize("right", [0, 4, 8])
def test_no_pair_of_matches_leads_to_more_places_than_the_consensus_has(right):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        matches = matched.pair(rng, 40, ((right, T_TRUE),), side=matched.plate_side)[2]
        o = ConsensusOptions()
        limits = o.tolerance_mm, o.normal_angle_rad, o.frame_angle_rad, o.distinct_mm
        _, counts = kernel(matches, o)
        assert counts[:, 0].max(initial=2) >= reference.best_of_all_pairs(*arrays(matches), *limits)


def test_members_are_the_matches_that_agree_by_definition():
    rng = np.random.default_rng(3)
    a, _, matches = matched.pair(rng, 300, ((60, T_TRUE),))
    best = find_consensus(matches).candidates[0]
    o = ConsensusOptions()
    expected = reference.agreeing(best.T_a_b, *arrays(matches), o.tolerance_mm, o.normal_angle_rad, o.frame_angle_rad)
    np.testing.assert_array_equal(best.members, expected)
    assert best.places == count_places(a.points_sensor[best.members], o.distinct_mm)


def kernel(matches, o, threads=2):
    return _core.find_consensus(
        *arrays(matches), o.tolerance_mm, o.frame_angle_rad, o.normal_angle_rad, o.distinct_mm, 5, threads
    )


def test_the_kernel_counts_what_agrees_with_its_transforms_rightly():
    rng = np.random.default_rng(5)
    matches, o = matched.pair(rng, 300, ((60, T_TRUE),))[2], ConsensusOptions()
    transforms, counts = kernel(matches, o)
    assert len(transforms) >= 1
    assert (np.diff(counts[:, 0]) <= 0).all()
    for T, (places, support) in zip(transforms, counts, strict=True):
        members = reference.agreeing(T, *arrays(matches), o.tolerance_mm, o.normal_angle_rad, o.frame_angle_rad)
        assert len(members) == support
        assert reference.cells(matches.points_a[members], o.distinct_mm) == places


def test_the_consensus_is_the_same_for_any_number_of_threads():
    rng = np.random.default_rng(6)
    matches = matched.pair(rng, 400, ((40, T_TRUE),))[2]
    results = [find_consensus(matches, threads=threads) for threads in (1, 2, 8)]
    assert len({r.candidates[0].T_a_b.tobytes() + r.candidates[0].members.tobytes() for r in results}) == 1


def test_the_order_of_the_matches_does_not_matter():
    rng = np.random.default_rng(7)
    matches = matched.pair(rng, 400, ((40, T_TRUE),))[2]
    first = find_consensus(matches).candidates[0]
    order = rng.permutation(len(matches))
    second = find_consensus(matches.take(order)).candidates[0]
    assert set(order[second.members]) == set(first.members)
    np.testing.assert_allclose(second.T_a_b, first.T_a_b, atol=1e-9)  # sums in another order


def test_a_second_motion_is_the_second_candidate():
    rng = np.random.default_rng(8)
    other = T_TRUE @ exp_se3([0, 0, 0, 35, 0, 0])
    _, b, matches = matched.pair(rng, 300, ((60, T_TRUE), (40, other)))
    first, second = find_consensus(matches).candidates[:2]
    assert worst_error_mm(first.T_a_b, b.points_sensor) < TRANSFORM_TOLERANCE_MM
    assert rotation_angle(second.T_a_b[:3, :3].T @ other[:3, :3]) < 0.01
    assert set(first.members) <= set(range(60)) | set(range(100, 300))


def test_excluded_matches_take_no_part():
    rng = np.random.default_rng(9)
    other = T_TRUE @ exp_se3([0, 0, 0, 35, 0, 0])
    matches = matched.pair(rng, 300, ((60, T_TRUE), (40, other)))[2]
    exclude = np.arange(300) < 60
    best = find_consensus(matches, exclude=exclude).candidates[0]
    assert best.members.min() >= 60
    assert rotation_angle(best.T_a_b[:3, :3].T @ other[:3, :3]) < 0.01


def test_random_matches_give_no_significant_consensus():
    for seed in range(5):
        matches = matched.pair(np.random.default_rng(seed), 500)[2]
        found = find_consensus(matches)
        places = found.candidates[0].places if found.candidates else 0
        assert log10_false_alarms(places, found.places, found.chance, 1) > -1


@pytest.mark.parametrize("extent_mm", [(300.0, 250.0), (300.0, 25.0)])
def test_false_alarms_on_random_matches_are_no_more_than_stated(extent_mm):
    """Of runs of one pair each, at most a share of 10^-k has a number of false alarms below 10^-k."""
    trials, stated = 120, []
    for seed in range(trials):
        rng = np.random.default_rng(1000 + seed)
        a, b = matched.random_side(rng, 120, extent_mm), matched.random_side(rng, 120, extent_mm)
        found = find_consensus(matched.matches_of(a, b), ConsensusOptions(), threads=1)
        places = found.candidates[0].places if found.candidates else 0
        stated.append(log10_false_alarms(places, found.places, found.chance, 1))
    for k in (0.0, 0.5, 1.0, 1.5):
        expected = trials * 10**-k
        # Three standard deviations of a Poisson number.
        assert np.sum(np.array(stated) < -k) <= expected + 3 * np.sqrt(expected)


def test_too_few_matches_give_no_candidate():
    matches = matched.pair(np.random.default_rng(0), 30, ((30, T_TRUE),))[2]
    for n in (0, 1, 2):
        found = find_consensus(matches.take(np.arange(n)))
        assert found.candidates == ()
        assert found.chance == 1.0


def test_places_nearer_than_the_limit_count_once():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1.9, 0, 0], [4, 0, 0], [4.5, 0, 0]])
    assert count_places(points, 2.0) == 2
    assert count_places(points, 0.4) == 5
    assert count_places(points[:0], 2.0) == 0


@pytest.mark.parametrize("distinct_mm", [0.5, 3.0, 20.0])
def test_places_are_counted_in_their_order(distinct_mm):
    points = np.random.default_rng(5).normal(0, 10, (150, 3))
    assert count_places(points, distinct_mm) == reference.places(points, distinct_mm)
