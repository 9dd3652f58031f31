"""The adjustment of panels, rings and chains: equations, statistics, blunders, datum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from networks.drawn import FIELD, SIGMA, draw_pairs, misplaced, panel, ring, shift, unused
from planish.geometry import adjoint, difference, exp_se3, invert, log_se3, perturb, transform_points, translation
from planish.registration.network.adjust import NetworkOptions, adjust
from planish.registration.network.batch import adjoints, exponentials, inverses, logarithms
from planish.registration.network.blocks import factor
from planish.registration.network.build import build_network
from planish.registration.network.groups import choose_reference, start_transforms
from planish.registration.network.joint import JointCovariances
from planish.registration.network.relations import Stack, pair_relation

#: Sums of some thousand products in another order.
ROUNDING = 1e-9


def dense(n, i, j, blocks):
    N = np.zeros((6 * n, 6 * n))
    for a, b, block in zip(i, j, blocks, strict=True):
        N[6 * a : 6 * a + 6, 6 * b : 6 * b + 6] += block
        if a != b:
            N[6 * b : 6 * b + 6, 6 * a : 6 * a + 6] += block.T
    return N


def test_the_sparse_factor_solves_and_inverts_as_a_dense_one_does():
    rng, n = np.random.default_rng(1), 14
    edges = [(a, b) for a in range(n) for b in range(a + 1, n) if rng.random() < 0.25 or b == a + 1]
    i, j, blocks = [], [], []
    for a, b in edges:
        # Rotations and translations differ by orders of magnitude, either order of a and b.
        A = rng.standard_normal((12, 12)) * np.tile([1e3] * 3 + [1.0] * 3, 2)
        H, (a, b) = A.T @ A, ((a, b) if rng.random() < 0.5 else (b, a))
        i, j, blocks = [*i, a, b, a], [*j, a, b, b], [*blocks, H[:6, :6], H[6:, 6:], H[:6, 6:]]
    # Two say something of the same two unknowns.
    i, j, blocks = [*i, *i[-3:]], [*j, *j[-3:]], [*blocks, *blocks[-3:]]
    i, j, blocks = np.array(i), np.array(j), np.array(blocks)
    found, N = factor(n, i, j, blocks), dense(n, i, j, blocks)
    rhs = rng.standard_normal((n, 6, 2))
    expected = np.linalg.solve(N, rhs.reshape(6 * n, 2)).reshape(n, 6, 2)
    np.testing.assert_allclose(found.solve(rhs), expected, rtol=1e-6, atol=ROUNDING * np.abs(expected).max())
    at_i, at_j = np.r_[i, j], np.r_[j, i]
    inverse = np.linalg.inv(N)
    for a, b, block in zip(at_i, at_j, found.inverse_blocks(at_i, at_j), strict=True):
        there = inverse[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
        np.testing.assert_allclose(block, there, rtol=1e-6, atol=1e-7 * np.abs(there).max())


def test_equations_that_hold_nothing_of_an_unknown_are_refused():
    blocks = np.array([np.eye(6), np.zeros((6, 6))])
    with pytest.raises(np.linalg.LinAlgError, match="held by nothing"):
        factor(2, np.array([0, 1]), np.array([0, 1]), blocks)


def test_the_reference_of_many_measurements_lies_in_their_middle():
    truth = panel(21, 15)
    middle = np.mean([T[:2, 3] for T in truth.T.values()], axis=0)
    chosen = choose_reference(sorted(truth.T), draw_pairs(truth))
    # Within two of 315 places along either axis: what the ways to every second of them tell.
    assert (np.abs(truth.T[chosen][:2, 3] - middle) < 2.5 * 0.65 * np.array(FIELD)).all()


def test_motions_of_many_transforms_are_those_of_one():
    rng = np.random.default_rng(2)
    xi = rng.standard_normal((50, 6)) * np.array([0.8] * 3 + [100.0] * 3)
    xi[:5, :3] *= 1e-7
    T = exponentials(xi)
    for one, vector, A, back in zip(T, xi, adjoints(T), inverses(T), strict=True):
        np.testing.assert_allclose(one, exp_se3(vector), atol=1e-11)
        np.testing.assert_allclose(A, adjoint(one), atol=1e-11)
        np.testing.assert_allclose(back, invert(one), atol=1e-11)
    np.testing.assert_allclose(logarithms(T), [log_se3(one) for one in T], atol=1e-10)


def test_the_derivatives_of_the_residuals_are_those_of_central_differences():
    truth = panel(3, 2)
    pairs = draw_pairs(truth, seed=3)
    names = sorted(truth.T)
    stack = Stack([pair_relation(p) for p in pairs], {name: i for i, name in enumerate(names)})
    start = start_transforms(names, names[0], pairs)
    T, own = np.array([start[n] for n in names]), np.array([truth.centroids[n] for n in names])

    def residuals(T):
        return stack.linearise(T, centres).r

    centres = np.array([transform_points(T[i], own[i]) for i in range(len(names))])
    lin = stack.linearise(T, centres)
    step = np.array([1e-6] * 3 + [1e-3] * 3)
    for m in range(len(names)):
        for k in range(6):
            moved = [T.copy(), T.copy()]
            for sign, item in zip((1, -1), moved, strict=True):
                item[m] = perturb(T[m], sign * step[k] * np.eye(6)[k], centres[m])
            numeric = (residuals(moved[0]) - residuals(moved[1])) / (2 * step[k])
            expected = -lin.by_a[:, :, k] * (stack.a == m)[:, None] - lin.by_b[:, :, k] * (stack.b == m)[:, None]
            # The residuals are a few hundredths of a milliradian: first order in them is left out.
            np.testing.assert_allclose(numeric, expected, atol=2e-3 * np.abs(expected).max() + 1e-3)


def nees_of(result, truth):
    reference = result.groups[0].reference
    xi = misplaced(truth, result.measurements, invert(truth.T[reference]))
    return [
        xi[m.name] @ np.linalg.solve(m.covariance_noise, xi[m.name]) / 6
        for m in result.measurements
        if m.name != reference
    ]


@pytest.mark.parametrize("shape", ["panel", "ring", "chain"])
def test_errors_of_synthetic_networks_are_as_large_as_their_covariances_say(shape):
    values, factors = [], []
    for seed in range(40):
        truth = ring(16) if shape == "ring" else panel(6, 4, seed) if shape == "panel" else panel(12, 1, seed)
        result = build_network(truth.nodes(), draw_pairs(truth, seed))
        factor_ = result.network.variance_factors["0"]
        factors.append(factor_)
        values += [value * max(1.0, factor_) for value in nees_of(result, truth)]
        assert unused(result.pairs) == set()
    # Measurements of a network share their errors: 40 networks know the mean to some 5 to 8 %.
    assert np.mean(values) == pytest.approx(1, abs=0.2)
    # A ring has six redundant equations: 40 of them know the factor to 9 %.
    assert np.mean(factors) == pytest.approx(1, abs=0.3)


def test_three_wrong_pairs_of_a_panel_are_named_and_no_right_one_goes():
    for seed in range(6):
        truth = panel(8, 5, seed)
        rng = np.random.default_rng(seed)
        chosen = [truth.overlaps[k] for k in rng.choice(len(truth.overlaps), 3, replace=False)]
        wrong = {pair: shift(5.0, [seed, k]) for k, pair in enumerate(chosen)}
        result = build_network(truth.nodes(), draw_pairs(truth, seed, wrong))
        assert unused(result.pairs) == set(wrong)
        for pair in result.pairs:
            if not pair.used:
                # The reason names the size that was planted: 5 mm, and what the pair's noise adds.
                assert float(pair.removed_reason.split(" by ")[1].split(" mm")[0]) == pytest.approx(5, abs=0.05)
        xi = misplaced(truth, result.measurements, invert(truth.T[result.groups[0].reference]))
        assert max(np.linalg.norm(x[3:]) for x in xi.values()) < 0.1


def test_wrong_pairs_side_by_side_do_not_drag_right_ones_out_with_them():
    """All pairs of one measurement but three are wrong, each another way: their neighbours must stay."""
    truth = panel(5, 5, 1)
    name = max(truth.T, key=lambda n: sum(n in pair for pair in truth.overlaps))
    around = [pair for pair in truth.overlaps if name in pair]
    assert len(around) == 8
    wrong = {pair: shift(5.0, [9, k]) for k, pair in enumerate(around[:4])}
    result = build_network(truth.nodes(), draw_pairs(truth, 1, wrong))
    assert unused(result.pairs) == set(wrong)


def test_pairs_that_agree_outvote_more_wrong_ones_that_do_not():
    """A measurement at the rim with five pairs: three wrong, each another way, against two right ones."""
    truth = panel(4, 3, 1)
    name = next(n for n in sorted(truth.T) if sum(n in pair for pair in truth.overlaps) == 5)
    around = [pair for pair in truth.overlaps if name in pair]
    for seed in range(4):
        chosen = np.random.default_rng(seed).permutation(5)[:3]
        wrong = {around[k]: shift(5.0, [seed, int(k), 2]) for k in chosen}
        result = build_network(truth.nodes(), draw_pairs(truth, seed, wrong))
        assert unused(result.pairs) == set(wrong)
        assert len(result.groups) == 1


def test_where_nothing_decides_a_measurement_stands_apart_rather_than_wrong():
    """Three pairs hold a corner, all of them contradict each other: none is used; stronger evidence decides."""
    truth = panel(4, 3, 1)
    name = next(n for n in sorted(truth.T) if sum(n in pair for pair in truth.overlaps) == 3)
    around = [pair for pair in truth.overlaps if name in pair]
    wrong = {pair: shift(5.0, [k, 4]) for k, pair in enumerate(around[:2])}
    pairs = draw_pairs(truth, 1, wrong)
    result = build_network(truth.nodes(), pairs)
    assert unused(result.pairs) == set(around)
    assert [m.name for m in result.measurements if m.group == 1] == [name]
    assert any("none is used" in w or "contradicts" in w for w in result.network.warnings)
    strong = [replace(p, log10_false_alarms=-200.0) if (p.a, p.b) == around[2] else p for p in pairs]
    result = build_network(truth.nodes(), strong)
    assert unused(result.pairs) == set(wrong)
    (sentence,) = result.network.warnings
    assert sentence.startswith(f"{name} hangs on one pair")
    assert "contradict it were taken out" in sentence


def test_the_free_datum_changes_covariances_but_no_transform_and_has_the_least_trace():
    truth = panel(4, 3)
    pairs = draw_pairs(truth, 5)
    fixed = build_network(truth.nodes(), pairs)
    free = build_network(truth.nodes(), pairs, NetworkOptions(datum="free"))
    traces = {}
    for key, result in (("fixed", fixed), ("free", free)):
        traces[key] = sum(np.trace(m.covariance_noise[3:, 3:]) for m in result.measurements)
    for one, two in zip(fixed.measurements, free.measurements, strict=True):
        np.testing.assert_array_equal(one.T_world_measurement, two.T_world_measurement)
        assert np.linalg.eigvalsh(two.covariance_noise).min() > 0
    assert traces["free"] < traces["fixed"]
    # The reference is as uncertain as its neighbours, not certain.
    reference = next(m for m in free.measurements if m.name == free.groups[0].reference)
    assert np.sqrt(np.trace(reference.covariance_noise[3:, 3:])) > 0.2 * SIGMA[3]


def test_the_free_covariance_does_not_depend_on_the_reference():
    truth = panel(3, 2)
    pairs, names = draw_pairs(truth, 6), sorted(truth.T)
    options = NetworkOptions(datum="free")
    found = {n: adjust(start_transforms(names, n, pairs), n, pairs, truth.centroids, options) for n in names[:2]}
    T = {n: item.T_world_measurement for n, item in found.items()}
    turn = invert(T[names[1]][names[0]])  # from the world of names[1] to that of names[0]
    R = np.kron(np.eye(2), turn[:3, :3])
    for name in names:
        C = R @ found[names[1]].covariance[name] @ R.T
        scale = np.array([100.0] * 3 + [1.0] * 3)
        expected = found[names[0]].covariance[name]
        largest = np.abs(expected * np.outer(scale, scale)).max()
        np.testing.assert_allclose(C * np.outer(scale, scale), expected * np.outer(scale, scale), atol=1e-3 * largest)


def test_network_h5_holds_the_covariance_of_any_measurement_relative_to_any_other(tmp_path):
    truth = panel(4, 3)
    pairs = draw_pairs(truth, 7)
    result = build_network(truth.nodes(), pairs)
    result.joint.save(tmp_path / "network.h5")
    joint = JointCovariances.load(tmp_path / "network.h5")
    names = sorted(truth.T)
    for reference in names[:3]:
        # The network with that reference states the covariance of all others relative to it.
        other = {m.name: m for m in build_network(truth.nodes(), pairs, reference=reference).measurements}
        for name in names:
            if name == reference:
                continue
            found = joint.between(reference, name)
            np.testing.assert_allclose(found.T_a_b, other[name].T_world_measurement, atol=1e-6)
            np.testing.assert_allclose(found.point_a_mm, other[name].covariance_point_mm, atol=1e-6)
            expected = other[name].covariance_noise
            np.testing.assert_allclose(found.covariance_noise, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())
            moved = found.about(np.zeros(3))
            A = adjoint(translation(found.point_a_mm))
            np.testing.assert_allclose(moved.covariance_noise, A @ found.covariance_noise @ A.T, rtol=1e-9)


def test_the_covariance_between_two_measurements_is_that_of_sampled_networks():
    values = []
    for seed in range(60):
        truth = panel(5, 2, 3)
        a, b = sorted(truth.T)[0], sorted(truth.T)[-1]
        found = build_network(truth.nodes(), draw_pairs(truth, seed)).joint.between(a, b)
        xi = difference(truth.T_a_b(a, b), found.T_a_b, found.point_a_mm)
        values.append(xi @ np.linalg.solve(found.covariance_noise, xi) / 6)
    # 60 draws of six: 7 %; the covariance is widened where a network closes badly by chance: up to 10 %.
    assert np.mean(values) == pytest.approx(1, abs=0.25)


def test_the_same_network_gives_the_same_bytes_in_any_order(tmp_path):
    truth = panel(5, 4)
    pairs, nodes = draw_pairs(truth, 8, {truth.overlaps[3]: shift(5, 1)}), truth.nodes()
    contents = set()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        result = build_network(
            [nodes[i] for i in rng.permutation(len(nodes))], [pairs[i] for i in rng.permutation(len(pairs))]
        )
        result.save(tmp_path / "registration.json")
        contents.add((tmp_path / "registration.json").read_bytes())
    assert len(contents) == 1
