"""The network: groups, adjustment, covariance, blunders."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from planish.geometry import difference, exp_se3, invert, perturb, transform_points
from planish.registration.network.adjust import adjust
from planish.registration.network.build import Node, build_network
from planish.registration.network.groups import choose_reference, find_groups, start_transforms
from planish.registration.result import PairResult

#: Standard deviations of a pair [rad, mm].
SIGMA = np.array([3e-5, 3e-5, 6e-5, 0.006, 0.006, 0.002])
COVARIANCE = np.diag(SIGMA**2)
NAMES = ("a", "b", "c", "d")
TRUTH = {
    "a": np.eye(4),
    "b": exp_se3([0.02, 0.1, 0.3, 200, 10, 0]),
    "c": exp_se3([-0.1, 0.05, -0.5, 220, 190, 15]),
    "d": exp_se3([0.2, 0, 1.0, 10, 200, -5]),
}
CENTROIDS = {"a": [5.0, 3, 0], "b": [-10.0, 0, 2], "c": [0.0, 20, 0], "d": [0.0, 0, 0]}
#: Gauss-Newton ends at steps of 1e-9 [rad, mm]; lever arms are hundreds of millimetres.
EXACT = 1e-6


def pair(a, b, rng=None, error=None, **changes):
    """An accepted pair with an error drawn from COVARIANCE, or with a given error xi."""
    T = invert(TRUTH[a]) @ TRUTH[b]
    p = transform_points(T, np.array(CENTROIDS[b])) / 2
    xi = np.zeros(6) if rng is None else SIGMA * rng.standard_normal(6)
    xi = xi if error is None else xi + error
    return PairResult(
        a, b, "accepted", "", T_a_b=perturb(T, xi, p), covariance_noise=COVARIANCE, covariance_point_mm=p, used=True,
        **changes,
    )  # fmt: skip


def solve(pairs, names=NAMES, reference="a"):
    return adjust(start_transforms(names, reference, pairs), reference, pairs, CENTROIDS)


def network(pairs, names=NAMES, **options):
    return build_network(
        [Node(n, f"{n}.h5", "0", np.array(CENTROIDS.get(n, [0, 0, 0]))) for n in names], pairs, **options
    )


def errors(found, names=NAMES, reference="a"):
    """True xi (6,) per name about the own centroid in the reference's frame."""
    out = {}
    for name in names:
        T = invert(TRUTH[reference]) @ TRUTH[name]
        out[name] = difference(T, found[name], transform_points(found[name], np.array(CENTROIDS[name])))
    return out


ALL = tuple(combinations(NAMES, 2))


def test_exact_pairs_give_the_exact_transforms_without_residual():
    found = solve([pair(*names) for names in ALL])
    assert max(np.abs(xi).max() for xi in errors(found.T_world_measurement).values()) < EXACT
    assert max(c.mm for c in found.contradictions.values()) < EXACT
    assert found.variance_factor < EXACT


def test_noisy_pairs_in_loops_are_better_than_a_chain():
    squares = {"all": 0.0, "chain": 0.0}
    for seed in range(30):
        rng = np.random.default_rng(seed)
        pairs = [pair(*names, rng) for names in ALL]
        chain = [p for p in pairs if (p.a, p.b) in (("a", "b"), ("b", "c"), ("c", "d"))]
        for key, chosen in (("all", pairs), ("chain", chain)):
            squares[key] += np.sum(errors(solve(chosen).T_world_measurement)["d"][3:] ** 2)
    # One pair straight to d and paths beside it: at least twice as certain as three in a row.
    assert squares["all"] < 0.5 * squares["chain"]


def test_the_stated_covariance_is_that_of_the_sampled_errors():
    nees, factors = [], []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        found = solve([pair(*names, rng) for names in ALL])
        xi = errors(found.T_world_measurement)
        factors.append(found.variance_factor)
        for name in "bcd":
            # Without the factor that a badly closing network is widened by.
            C = found.covariance[name] / max(1.0, found.variance_factor)
            nees.append(xi[name] @ np.linalg.solve(C, xi[name]) / 6)
    # 150 networks of 18 unknowns know the mean to 3 %, the factor (18 redundant) to 3 %.
    assert np.mean(nees) == pytest.approx(1, abs=0.1)
    assert np.mean(factors) == pytest.approx(1, abs=0.1)


def test_loops_that_close_badly_widen_the_covariance():
    rng = np.random.default_rng(1)
    good = solve([pair(*names, rng) for names in ALL])
    rng = np.random.default_rng(1)
    bad = solve([pair(*names, error=4 * SIGMA * rng.standard_normal(6)) for names in ALL])
    assert bad.variance_factor > 5
    ratio = bad.covariance["c"][3, 3] / good.covariance["c"][3, 3]
    assert ratio == pytest.approx(bad.variance_factor / max(1, good.variance_factor), rel=0.01)


def test_the_reference_does_not_move_and_has_no_uncertainty():
    rng = np.random.default_rng(2)
    for reference in NAMES:
        found = solve([pair(*names, rng) for names in ALL], reference=reference)
        np.testing.assert_array_equal(found.T_world_measurement[reference], np.eye(4))
        assert not found.covariance[reference].any()
        assert all(np.linalg.eigvalsh(found.covariance[n]).min() > 0 for n in NAMES if n != reference)


def test_a_single_edge_keeps_its_transform_and_covariance():
    only = pair("a", "b", np.random.default_rng(3))
    found = solve([only], ("a", "b"))
    np.testing.assert_allclose(found.T_world_measurement["b"], only.T_a_b, atol=EXACT)
    # About the centroid of b instead of the overlap's: translations at the overlap's centre are the same.
    p, q = only.covariance_point_mm, transform_points(only.T_a_b, np.array(CENTROIDS["b"]))
    A = np.eye(6)
    d = q - p
    A[3:, :3] = -np.array([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
    np.testing.assert_allclose(found.covariance["b"], A @ COVARIANCE @ A.T, rtol=1e-6, atol=1e-14)
    assert found.variance_factor == 1


def test_a_blunder_in_a_network_of_loops_is_taken_out_and_named():
    for wrong in ALL:
        rng = np.random.default_rng(4)
        pairs = [pair(*names, rng, error=[0, 0, 0, 5, 0, 0] if names == wrong else None) for names in ALL]
        result = network(pairs, reference="a")
        assert [(p.a, p.b) for p in result.pairs if not p.used] == [wrong]
        removed = next(p for p in result.pairs if not p.used)
        assert "contradicts the other pairs" in removed.removed_reason
        assert removed.status == "accepted"
        assert removed.T_a_b is not None
        T = {m.name: m.T_world_measurement for m in result.measurements}
        assert max(np.abs(xi[3:]).max() for xi in errors(T).values()) < 0.05


@pytest.mark.parametrize("wrong", ALL)
def test_a_blunder_is_found_even_where_it_is_stated_as_the_most_certain_pair(wrong):
    rng = np.random.default_rng(4)
    pairs = [pair(*names, rng, error=[0, 0, 0, 5, 0, 0] if names == wrong else None) for names in ALL]
    pairs = [replace(p, covariance_noise=COVARIANCE / 25) if (p.a, p.b) == wrong else p for p in pairs]
    assert [(p.a, p.b) for p in network(pairs).pairs if not p.used] == [wrong]


@pytest.mark.parametrize("wrong", ALL[:2] + ALL[3:4])
def test_in_a_lone_triangle_the_pair_with_the_weakest_evidence_goes(wrong):
    rng = np.random.default_rng(4)
    pairs = []
    for names in combinations("abc", 2):
        weak = names == wrong
        error = [0, 0, 0, 5, 0, 0] if weak else None
        pairs.append(pair(*names, rng, error, log10_false_alarms=-4.0 if weak else -100.0))
    assert [(p.a, p.b) for p in network(pairs, ("a", "b", "c")).pairs if not p.used] == [wrong]


def test_two_blunders_are_taken_out_one_after_the_other():
    rng = np.random.default_rng(5)
    names = (*NAMES, "e")
    TRUTH["e"], CENTROIDS["e"] = exp_se3([0, 0, 0.2, 100, 100, 0]), [1.0, 2, 3]
    wrong = {("a", "b"): [0, 0, 0, 5, 0, 0], ("c", "d"): [0, 0, 0, 0, -8, 0]}
    pairs = [pair(*n, rng, error=wrong.get(n)) for n in combinations(names, 2)]
    result = network(pairs, names)
    assert {(p.a, p.b) for p in result.pairs if not p.used} == set(wrong)
    del TRUTH["e"], CENTROIDS["e"]


def test_chains_have_nothing_to_contradict_them_and_are_kept():
    pairs = [pair("a", "b", error=[0, 0, 0, 5, 0, 0]), pair("b", "c"), pair("c", "d")]
    result = network(pairs)
    assert all(p.used for p in result.pairs)
    assert len(result.groups) == 1


def test_what_is_not_tied_in_gets_a_group_of_its_own():
    refused = PairResult("b", "c", "refused", "no consensus")
    result = network([pair("a", "b"), refused, pair("c", "d")], (*NAMES, "alone"))
    members = {g.id: [m.name for m in result.measurements if m.group == g.id] for g in result.groups}
    assert list(members.values()) == [["a", "b"], ["c", "d"], ["alone"]]
    for group in result.groups:
        reference = next(m for m in result.measurements if m.name == group.reference)
        np.testing.assert_array_equal(reference.T_world_measurement, np.eye(4))
    np.testing.assert_allclose(
        next(m.T_world_measurement for m in result.measurements if m.name == "d"),
        invert(TRUTH["c"]) @ TRUTH["d"], atol=EXACT,
    )  # fmt: skip


def test_the_order_of_measurements_and_pairs_does_not_change_the_result():
    rng = np.random.default_rng(6)
    pairs = [pair(*names, rng) for names in ALL]
    first = network(pairs)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(pairs))
        second = network([pairs[i] for i in order], tuple(np.random.default_rng(seed).permutation(NAMES)))
        assert second.groups == first.groups
        for one, two in zip(first.measurements, second.measurements, strict=True):
            assert one.name == two.name
            np.testing.assert_array_equal(one.T_world_measurement, two.T_world_measurement)
            np.testing.assert_array_equal(one.covariance_noise, two.covariance_noise)
        assert [(p.a, p.b) for p in second.pairs] == [(p.a, p.b) for p in first.pairs]


def test_the_most_central_measurement_is_the_reference():
    assert choose_reference(("a", "b", "c"), [pair("a", "b"), pair("b", "c")]) == "b"
    assert network([pair("a", "b"), pair("b", "c")], ("a", "b", "c")).groups[0].reference == "b"
    assert network([pair("a", "b"), pair("b", "c")], ("a", "b", "c"), reference="c").groups[0].reference == "c"
    assert choose_reference(("x",), []) == "x"


def test_groups_come_largest_first_and_follow_used_pairs():
    pairs = [pair("c", "d"), pair("b", "d"), PairResult("a", "b", "refused", "")]
    assert find_groups(NAMES, pairs) == [["b", "c", "d"], ["a"]]
