"""What the network says of itself: loops, drift, what hangs on one pair, advice for what stays apart."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from networks.drawn import draw_pairs, panel, ring, shift
from planish.geometry import invert, perturb, transform_points
from planish.registration.network.adjust import adjust
from planish.registration.network.build import build_network
from planish.registration.network.groups import start_transforms
from planish.registration.network.loops import chain_of, fundamental_loops, graph_of
from planish.registration.network.relinearise import at_the_network, quadratic
from planish.registration.result import PairResult, Registration
from planish.report.network import network_lines, network_section


def network(truth, pairs, **options):
    return build_network(truth.nodes(), pairs, **options)


def test_a_ring_has_one_loop_whose_closure_is_what_was_put_into_it():
    truth = ring(16)
    pairs = draw_pairs(truth, None)
    assert network(truth, pairs).network.loops[0].closure_mm < 1e-6
    # 0.3 mm in one pair: less than a blunder, all of it shows in the closure, a sixteenth of it is left in each pair.
    opened = [replace(p, T_a_b=perturb(p.T_a_b, shift(0.3, 1), p.covariance_point_mm)) if i == 4 else p
              for i, p in enumerate(pairs)]  # fmt: skip
    (loop,) = network(truth, opened).network.loops
    assert sorted(loop.measurements) == sorted(truth.T)
    assert loop.closure_mm == pytest.approx(0.3, rel=1e-3)
    assert loop.adjusted_mm < 0.3


@pytest.mark.parametrize("tree", ["leaves out the corners' own pairs", "leaves out the corners' shortcuts"])
def test_the_ring_is_among_the_loops_whatever_shortcuts_it_has(tree):
    """Two corners of a ring of eight have shortcuts: two triangles, and one loop that goes all the way round."""
    rim = [f"m{k}" for k in range(8)]
    own, shortcuts = list(pairwise([*rim, rim[0]])), [("m0", "m2"), ("m4", "m6")]
    beside = [("m0", "m1"), ("m4", "m5")] if "own" in tree else shortcuts
    # The last pair beside the tree closes a triangle, too, where the tree goes the other way round.
    beside = [*beside, ("m1", "m2") if "shortcuts" in tree else ("m2", "m3")]
    pairs = [PairResult(a=a, b=b, status="accepted", reason="", used=True, T_a_b=np.eye(4)) for a, b in own + shortcuts]
    loops = fundamental_loops(graph_of(pairs, rim), [e for e in own + shortcuts if e not in beside])
    lengths = sorted(len(loop) for loop in loops)
    assert lengths[:2] == [3, 3]
    assert len(lengths) == 3
    assert lengths[2] >= 6


def test_closures_are_as_large_as_predicted():
    values, rms, predicted = [], [], []
    for seed in range(60):
        truth = ring(16)
        (loop,) = network(truth, draw_pairs(truth, seed)).network.loops
        values.append(loop.sigma**2)
        rms.append(loop.closure_mm**2)
        predicted.append(loop.predicted_mm**2)
    # 60 closures of six: their mean square is known to 7 %, the three translations' to 11 %.
    assert np.mean(values) == pytest.approx(1, abs=0.25)
    assert np.mean(rms) == pytest.approx(np.mean(predicted), rel=0.4)


def test_the_error_of_a_walk_is_that_of_its_pairs_one_after_the_other():
    """Each pair in turn gets an error: first order, carried to the start, whichever way the pair is walked."""
    truth = ring(5)
    pairs = draw_pairs(truth, None)
    graph = graph_of(pairs, sorted(truth.T))
    (loop,) = fundamental_loops(graph, [(p.a, p.b) for p in pairs[:-1]])
    assert {step.forward for step in loop} == {True, False}
    point = np.array([10.0, 20.0, 600.0])
    for k in range(len(loop)):
        mode = np.array([2e-6, -1e-6, 3e-6, 1e-3, -2e-3, 5e-4])
        pair = loop[k].pair
        stated = [replace(s, pair=replace(s.pair, calibration_shifts={"one": mode[None]})) if i == k else s
                  for i, s in enumerate(loop)]  # fmt: skip
        wrong = replace(pair, T_a_b=perturb(pair.T_a_b, mode, pair.covariance_point_mm))
        moved = [replace(s, pair=wrong) if i == k else s for i, s in enumerate(loop)]
        chain = chain_of(stated)
        modes = chain.error_about(point)[1]
        expected = perturb(chain.T_start_end, modes[:, 0], point)
        np.testing.assert_allclose(chain_of(moved).T_start_end, expected, atol=1e-6)


def test_what_hangs_on_one_pair_is_said_and_nothing_else():
    truth = panel(4, 3)
    names, pairs = sorted(truth.T), draw_pairs(truth)
    assert network(truth, pairs).network.warnings == ()
    name = names[3]
    last = next(p for p in pairs if name in (p.a, p.b))
    result = network(truth, [p for p in pairs if name not in (p.a, p.b) or p is last])
    (sentence,) = result.network.warnings
    assert sentence.startswith(f"{name} hangs on one pair")
    assert "if it is wrong, nothing would notice" in sentence
    ties = {(t.a, t.b): t for t in result.network.ties}
    assert ties[last.a, last.b].redundancy == 0
    assert ties[last.a, last.b].detectable_mm is None
    assert all(t.redundancy > 0.1 and t.detectable_mm is not None for key, t in ties.items() if key != (last.a, last.b))


def test_in_a_long_chain_no_pair_is_checked_whatever_rounding_says():
    truth = panel(300, 1)
    ties = network(truth, draw_pairs(truth)).network.ties
    assert len(ties) == 299
    assert {tie.redundancy for tie in ties} == {0.0}


def test_the_redundancies_of_all_pairs_add_up_to_the_redundancy_of_the_network():
    truth = panel(4, 3)
    pairs = draw_pairs(truth)
    found = sum(6 * tie.redundancy for tie in network(truth, pairs).network.ties)
    assert found == pytest.approx(6 * (len(pairs) - len(truth.T) + 1), rel=1e-6)


def test_an_error_above_the_detectable_one_is_found_and_one_below_is_not():
    truth = panel(3, 3)
    pairs = draw_pairs(truth, None)
    ties = {(t.a, t.b): t for t in network(truth, pairs).network.ties}
    for pair in pairs[::4]:
        limit = ties[pair.a, pair.b].detectable_mm
        # Along the worst direction the limit is sharp, along others less is enough: twice is enough for all.
        for factor, found in ((0.5, False), (2.0, True)):
            wrong = {(pair.a, pair.b): np.array([0, 0, 0, factor * limit, 0, 0])}
            result = network(truth, draw_pairs(truth, None, wrong))
            assert any(not p.used for p in result.pairs) == found


def test_drift_grows_along_a_chain_and_loops_take_it_away():
    chain, both = panel(15, 1), panel(15, 3)
    lone = network(chain, draw_pairs(chain, 2), reference=sorted(chain.T, key=lambda n: chain.T[n][0, 3])[0])
    places = sorted(lone.network.places, key=lambda place: place.pairs_from_reference)
    sigmas = [place.chain_sigma_mm for place in places]
    assert sigmas[0] == 0
    assert all(a < b for a, b in pairwise(sigmas))
    # Nothing but the chain: the adjusted place is the chain's, its sigma too.
    assert max(place.chain_mm for place in places) < 1e-6
    np.testing.assert_allclose([place.sigma_mm for place in places], sigmas, rtol=1e-3)
    tied = network(both, draw_pairs(both, 2))
    far = max(tied.network.places, key=lambda place: place.chain_sigma_mm)
    assert far.sigma_mm < far.chain_sigma_mm
    assert far.chain_mm > 0


def test_groups_that_stay_apart_name_the_pair_that_came_closest_and_why_it_was_refused():
    one, two = panel(3, 2, 1, name="p"), panel(2, 2, 2, name="q")
    both = replace(one, T=one.T | two.T, centroids=one.centroids | two.centroids, overlaps=one.overlaps + two.overlaps)
    pairs = draw_pairs(both)
    a, b = sorted(one.T)[1], sorted(two.T)[2]
    pairs += [
        PairResult(a, b, "refused", "too little texture in the overlap", log10_false_alarms=-1.5),
        PairResult(sorted(one.T)[0], b, "refused", "no consensus", log10_false_alarms=2.0),
    ]
    result = network(both, pairs)
    assert sorted(len([m for m in result.measurements if m.group == g.id]) for g in result.groups) == [4, 6]
    (advice,) = result.network.advice
    assert (advice.a, advice.b, advice.groups) == (a, b, (0, 1))
    assert any("stay apart" in w and "too little texture" in w for w in result.network.warnings)


def test_the_summary_survives_its_file_and_is_told_in_the_report_and_on_the_command_line(tmp_path):
    truth = panel(4, 2)
    result = network(truth, draw_pairs(truth, 3, {truth.overlaps[2]: shift(5, 2)}))
    result.save(tmp_path / "registration.json")
    loaded = Registration.load(tmp_path / "registration.json")
    assert loaded.network == result.network
    assert json.loads((tmp_path / "registration.json").read_text())["network"]["loops"]
    lines = network_lines(loaded.network)
    assert any(line.startswith("Closure of ") and "predicted" in line for line in lines)
    assert any(line.startswith("Drift: ") for line in lines)
    section = network_section(loaded.network)
    assert section.startswith("<h2>Network</h2>")
    assert section.count("<table") == 2
    assert network_section(build_network(panel(1, 1).nodes(), []).network) == ""


def test_pairs_seen_from_the_network_by_their_own_parabolas_change_nothing():
    truth = panel(3, 2)
    pairs, names = draw_pairs(truth, 4), sorted(truth.T)
    found = adjust(start_transforms(names, names[0], pairs), names[0], pairs, truth.centroids)
    again = at_the_network(pairs, found, quadratic)
    for one, two in zip(pairs, again, strict=True):
        np.testing.assert_allclose(one.T_a_b, two.T_a_b, atol=1e-9)
        np.testing.assert_allclose(one.covariance_noise, two.covariance_noise, rtol=1e-6, atol=1e-15)


def test_a_pair_that_ended_in_a_side_minimum_is_put_right_where_the_network_takes_it():
    """Costs that are evaluated at the network's transforms find their true optimum; averaging transforms cannot."""
    truth = panel(3, 3)
    key = truth.overlaps[5]
    true_pairs = {(p.a, p.b): p for p in draw_pairs(truth, 6)}
    # It stopped 0.3 mm off, beyond its basin's linear range: too little for a blunder.
    stopped = [
        replace(p, T_a_b=perturb(p.T_a_b, shift(0.3, 5), p.covariance_point_mm)) if k == key else p
        for k, p in true_pairs.items()
    ]

    def costs(pair, T_a_b):
        return quadratic(true_pairs[pair.a, pair.b], T_a_b)

    errors = {}
    for name, normal_equations in (("averaged", None), ("seen from the network", costs)):
        result = network(truth, stopped, normal_equations=normal_equations)
        T = {m.name: m.T_world_measurement for m in result.measurements}
        gaps = [
            transform_points(invert(T[a]) @ T[b], truth.centroids[b])
            - transform_points(truth.T_a_b(a, b), truth.centroids[b])
            for a, b in truth.overlaps
        ]
        errors[name] = np.sqrt(np.mean(np.square(gaps)))
        # What was measured stays in the result as it was.
        assert np.array_equal(result.pair(*key).T_a_b, next(p for p in stopped if (p.a, p.b) == key).T_a_b)
    assert errors["seen from the network"] < 0.5 * errors["averaged"]


def test_a_lone_pair_has_no_loop_and_says_that_nothing_checks_it():
    truth = panel(2, 1)
    result = network(truth, draw_pairs(truth))
    assert result.network.loops == ()
    assert network_lines(result.network)[0].startswith("No loop of pairs")
