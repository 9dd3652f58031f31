"""Errors of the calibration in the network: common to all measurements of a rig, so that they do not average out."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from planish.geometry import adjoint, difference, exp_se3, invert, perturb, transform_points, translation
from planish.registration.network.adjust import adjust
from planish.registration.network.build import Node, build_network
from planish.registration.network.groups import start_transforms
from planish.registration.refine.calibration import calibration_covariance
from planish.report.text import position_sigma, verdict
from test_network import ALL, CENTROIDS, NAMES, TRUTH, pair

#: Standard deviations of the modes [rad, mm]: tens of those of the noise.
SIZE = np.array([1e-4, 1e-4, 1e-4, 0.05, 0.05, 0.05])
#: First order, transforms of hundreds of millimetres: second order is a share of this.
FIRST_ORDER = 1e-3


def shifted(a, b, seed=0, keys=("one",), rng=None, **changes):
    """A pair whose modes are drawn by its names, with noise drawn by `rng`."""
    number = NAMES.index(a) * 10 + NAMES.index(b)
    modes = {k: SIZE * np.random.default_rng([seed, number, i]).standard_normal((4, 6)) for i, k in enumerate(keys)}
    item = pair(a, b, rng, **changes)
    return replace(item, calibration_shifts=modes, covariance_calibration=calibration_covariance(modes))


def with_error(item, weights):
    """The pair as it is when the rigs have the errors `weights` (k,) per key, in standard deviations of their modes."""
    xi = sum(weights[key] @ modes for key, modes in item.calibration_shifts.items())
    return replace(item, T_a_b=perturb(item.T_a_b, xi, item.covariance_point_mm))


def solve(pairs, names=NAMES, reference="a"):
    return adjust(start_transforms(names, reference, pairs), reference, pairs, CENTROIDS)


def nodes(names=NAMES):
    return [Node(n, f"{n}.h5", "0", np.array(CENTROIDS[n])) for n in names]


def placed_errors(found, reference="a"):
    out = {}
    for name, T_hat in found.T_world_measurement.items():
        T = invert(TRUTH[reference]) @ TRUTH[name]
        point = transform_points(T_hat, np.array(CENTROIDS[name]))
        out[name] = -difference(T, T_hat, point)
    return out


@pytest.mark.parametrize("pairs", [ALL, (("a", "b"), ("b", "c"), ("c", "d"))], ids=["loops", "chain"])
def test_each_mode_moves_every_measurement_as_it_does_when_the_pairs_really_have_that_error(pairs):
    items = [shifted(*names) for names in pairs]
    found = solve(items)
    for k in range(4):
        moved = placed_errors(solve([with_error(p, {"one": np.eye(4)[k]}) for p in items]))
        for name in NAMES:
            expected = found.calibration[name][k]
            np.testing.assert_allclose(moved[name][3:], expected[3:], atol=0.02 * SIZE[3])
            np.testing.assert_allclose(moved[name][:3], expected[:3], atol=0.02 * SIZE[0])


def test_the_stated_covariance_is_that_of_networks_whose_rig_has_a_drawn_error():
    nees = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        errors = {key: rng.standard_normal(4) for key in ("one", "two")}
        items = [with_error(shifted(*names, keys=("one", "two"), rng=rng), errors) for names in ALL]
        placed = {m.name: m for m in build_network(nodes(), items, reference="a").measurements}
        for name in "bcd":
            T, m = invert(TRUTH["a"]) @ TRUTH[name], placed[name]
            xi = difference(T, m.T_world_measurement, m.covariance_point_mm)
            C = m.covariance_noise + m.covariance_calibration
            nees.append(xi @ np.linalg.solve(C, xi) / 6)
    # 200 rigs with 8 modes: their share of a mean NEES is known to 5 %.
    assert np.mean(nees) == pytest.approx(1, abs=0.15)


def test_more_pairs_average_noise_but_not_the_calibration():
    """All pairs wrong alike: T_world_measurement of a chain of equal steps is wrong by the sum of the steps."""
    mode = {"one": np.array([[0, 0, 0, 0.1, 0, 0]])}
    steps = {n: exp_se3([0, 0, 0, 100.0 * i, 0, 0]) for i, n in enumerate("abcd")}
    items = []
    for a, b in combinations("abcd", 2):
        count = "abcd".index(b) - "abcd".index(a)
        T = invert(steps[a]) @ steps[b]
        common = {"one": count * mode["one"]}
        items.append(replace(pair(a, b), T_a_b=T, covariance_point_mm=T[:3, 3] / 2, calibration_shifts=common))
    centroids = {n: np.zeros(3) for n in "abcd"}
    for used in (items, [p for p in items if ord(p.b) - ord(p.a) == 1]):
        found = adjust(steps, "a", used, centroids)
        for i, name in enumerate("abcd"):
            np.testing.assert_allclose(found.calibration[name], i * mode["one"], atol=1e-9)
    assert np.trace(adjust(steps, "a", items, centroids).covariance["d"]) < np.trace(found.covariance["d"])


def test_the_covariance_between_two_measurements_does_not_depend_on_the_reference():
    items = [shifted(*names) for names in ALL]
    from_a, from_b = solve(items), solve(items, reference="b")
    T = from_a.T_world_measurement
    at = {n: translation(transform_points(T[n], np.array(CENTROIDS[n]))) for n in NAMES}
    for name in "acd":
        # The motion of `name` less that of b as a rigid motion of its place, told in the frame of b.
        relative = from_a.calibration[name].T - adjoint(invert(at[name]) @ at["b"]) @ from_a.calibration["b"].T
        turned = from_b.T_world_measurement[name] @ invert(T[name])
        in_b = adjoint(np.block([[turned[:3, :3], np.zeros((3, 1))], [np.zeros((1, 3)), np.eye(1)]])) @ relative
        scale = np.array([100.0] * 3 + [1.0] * 3)
        np.testing.assert_allclose(scale * from_b.calibration[name], scale * in_b.T, atol=FIRST_ORDER)


def test_the_joint_covariance_knows_the_calibration_between_any_two_measurements():
    items = [shifted(*names) for names in ALL]
    joint = build_network(nodes(), items, reference="a").joint
    for reference in "bc":
        for placed in build_network(nodes(), items, reference=reference).measurements:
            if placed.name == reference:
                continue
            found, expected = joint.between(reference, placed.name), placed.covariance_calibration
            largest = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            np.testing.assert_allclose(found.covariance_calibration / largest, expected / largest, atol=FIRST_ORDER)


def test_the_reference_has_none_and_pairs_without_a_statement_leave_none():
    items = [shifted(*names) for names in ALL]
    result = build_network(nodes(), items, reference="a")
    assert not next(m for m in result.measurements if m.name == "a").covariance_calibration.any()
    items[2] = pair(items[2].a, items[2].b)
    result = build_network(nodes(), items, reference="a")
    assert all(m.covariance_calibration is None for m in result.measurements)


def test_loops_that_the_calibration_opens_neither_widen_the_noise_nor_count_as_blunders():
    """Modes that differ from pair to pair: what is left of them in the residuals is expected."""
    rng = np.random.default_rng(3)
    plain = [pair(*names, rng) for names in ALL]
    stated = [
        replace(p, calibration_shifts={"one": 40 * SIZE * np.random.default_rng(i).standard_normal((3, 6))})
        for i, p in enumerate(plain)
    ]
    opened = [with_error(p, {"one": np.array([1.0, -0.5, 0.8])}) for p in stated]
    blind = [replace(p, calibration_shifts=None) for p in opened]
    assert solve(blind).variance_factor > 100
    assert solve(opened).variance_factor < 3
    assert any(not p.used for p in build_network(nodes(), blind).pairs)
    assert all(p.used for p in build_network(nodes(), opened).pairs)


def test_a_blunder_far_beyond_the_calibration_is_still_found():
    for wrong in ALL:
        rng = np.random.default_rng(4)
        items = [shifted(*n, rng=rng, error=[0, 0, 0, 5, 0, 0] if n == wrong else None) for n in ALL]
        result = build_network(nodes(), items)
        assert [(p.a, p.b) for p in result.pairs if not p.used] == [wrong]


def test_the_report_says_what_the_uncertainty_comes_from():
    without = build_network(nodes(), [pair(*names) for names in ALL], reference="a")
    assert any("from noise alone: the rig states no covariance" in s for s in verdict(without)[1])
    stated = build_network(nodes(), [shifted(*names) for names in ALL], reference="a")
    assert any("(from noise and calibration)" in s for s in verdict(stated)[1])
    sigmas = [max(map(position_sigma, run.measurements)) for run in (without, stated)]
    assert sigmas[1] > 3 * sigmas[0]
