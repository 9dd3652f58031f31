"""Errors against truth: definitions, consistency of drawn errors with their covariance, the JSON, plain findings."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import registered
from planish import storage
from planish.errors import InputError
from planish.evaluation.truth import TruePlace, Truth, compare_with_truth, error_rms, nees
from planish.geometry import exp_se3, perturb
from planish.registration.result import Group


@pytest.fixture(scope="module")
def compared():
    items, truth = registered.prepared()
    result, _ = registered.registration()
    return result, truth, items, compare_with_truth(result, truth, items)


def test_nees_of_drawn_errors_has_six_degrees_of_freedom():
    rng = np.random.default_rng(7)
    point, T_true = np.array([100.0, -40.0, 12.0]), perturb(np.eye(4), [0.2, 0.1, -0.3, 50, 60, 70], [0, 0, 0])
    draws = [registered.draw(T_true, point, rng) for _ in range(400)]
    values = [nees(T, T_true, point, registered.COVARIANCE, None) for T in draws]
    # 400 draws of chi-square with 6 degrees of freedom: the mean's standard deviation is sqrt(12 / 400).
    assert np.mean(values) == pytest.approx(6, abs=4 * np.sqrt(12 / 400))
    halved = [nees(T, T_true, point, registered.COVARIANCE, registered.COVARIANCE) for T in draws]
    assert np.mean(halved) == pytest.approx(np.mean(values) / 2, rel=1e-9)


def test_nees_needs_a_covariance():
    assert nees(np.eye(4), np.eye(4), np.zeros(3), None, None) is None
    assert nees(np.eye(4), np.eye(4), np.zeros(3), np.zeros((6, 6)), None) is None


def test_an_error_is_split_into_its_parts_along_the_normal_and_along_the_surface():
    items, _ = registered.prepared()
    item = items["middle"]
    # A window in which the bent sheet's normal is nearly constant.
    pixels = np.zeros(item.measurement.shape, bool)
    pixels[100:104, 136:140] = True
    normal = item.surface.normals_sensor[pixels].mean(0).astype(float)
    across = np.cross(normal, [0, 1, 0]) / np.linalg.norm(np.cross(normal, [0, 1, 0]))
    moved = perturb(np.eye(4), [0, 0, 0, *(0.3 * normal + 0.4 * across)], [0, 0, 0])
    tangential, along_normal = error_rms(moved, np.eye(4), item, pixels)
    # Normals of single pixels differ by a hundredth.
    assert along_normal == pytest.approx(0.3, abs=0.01)
    assert tangential == pytest.approx(0.4, abs=0.01)


def test_accepted_pairs_and_measurements_are_compared_with_truth(compared):
    evaluation = compared[3]
    assert [(p.a, p.b) for p in evaluation.pairs] == [("left", "middle"), ("middle", "right")]
    for pair in evaluation.pairs:
        assert 0.3 < pair.overlap < 0.8
        assert pair.rotation_error_rad < 6 * registered.SIGMAS[0]
        assert 0 < pair.tangential_rms_mm < 0.03
        assert 0 < pair.normal_rms_mm < 0.03
        assert 0 < pair.nees < 25
    reference, *others = evaluation.measurements
    assert (reference.name, reference.nees) == ("left", None)
    assert reference.tangential_rms_mm < 1e-12  # nothing but the rounding of its own inverse
    assert all(0 < m.nees < 25 for m in others[:2])


def test_a_world_given_from_outside_changes_no_error_but_leaves_no_nees(compared):
    result, truth, items, evaluation = compared
    T = exp_se3([0.3, -0.2, 1.0, 500.0, -300.0, 800.0])
    moved = [
        replace(m, T_world_measurement=T @ m.T_world_measurement, covariance_noise=np.eye(6))
        for m in result.measurements
    ]
    again = compare_with_truth(replace(result, measurements=tuple(moved)), truth, items)
    for one, two in zip(again.measurements, evaluation.measurements, strict=True):
        assert one.tangential_rms_mm == pytest.approx(two.tangential_rms_mm, abs=1e-9)
        assert one.nees is None


def test_the_true_overlap_does_not_depend_on_the_estimate(compared):
    result, truth, items, evaluation = compared
    pair = result.pairs[0]
    shifted = replace(pair, T_a_b=perturb(pair.T_a_b, [0, 0, 0, 0.5, 0, 0], [0, 0, 0]))
    again = compare_with_truth(replace(result, pairs=(shifted, *result.pairs[1:])), truth, items)
    assert again.pairs[0].overlap == evaluation.pairs[0].overlap
    assert np.hypot(again.pairs[0].tangential_rms_mm, again.pairs[0].normal_rms_mm) == pytest.approx(0.5, abs=0.03)


def test_nothing_is_found_where_nothing_is_wrong(compared):
    assert compared[3].findings == ()


def test_an_accepted_pair_of_different_parts_is_called_wrong(compared):
    result, truth, items, _ = compared
    parts = truth.places | {"middle": TruePlace("another", truth.places["middle"].T_object_sensor)}
    found = compare_with_truth(result, Truth(parts), items)
    assert "WRONG: left, middle accepted, but they show different parts" in found.findings
    assert "WRONG: middle is tied to left, but they show different parts" in found.findings
    assert found.pairs[0].tangential_rms_mm is None
    assert found.measurements[1].nees is None


def test_a_wrong_transform_is_called_wrong(compared):
    result, truth, items, _ = compared
    far = replace(result.pairs[0], T_a_b=perturb(result.pairs[0].T_a_b, [0, 0, 0, 40, 0, 0], [0, 0, 0]))
    found = compare_with_truth(replace(result, pairs=(far, *result.pairs[1:])), truth, items)
    assert any(f.startswith("WRONG: left, middle accepted with an error of 4") for f in found.findings)


def test_an_overlapping_pair_that_is_not_accepted_is_called_missing(compared):
    result, truth, items, _ = compared
    refused = replace(result.pairs[0], status="refused", T_a_b=None)
    found = compare_with_truth(replace(result, pairs=(refused, *result.pairs[1:])), truth, items)
    assert any(f.startswith("missing: left, middle overlap by ") for f in found.findings)


def test_a_group_is_compared_in_the_frame_of_its_own_reference(compared):
    result, truth, items, _ = compared
    loose = replace(result.measurements[2], group=2, T_world_measurement=np.eye(4))
    changed = replace(
        result, groups=(*result.groups, Group(2, "right")),
        measurements=(*result.measurements[:2], loose, result.measurements[3]),
    )  # fmt: skip
    assert compare_with_truth(changed, truth, items).measurements[2].tangential_rms_mm == pytest.approx(0, abs=1e-9)


def test_the_json_has_exactly_the_keys_of_the_contract(compared, tmp_path):
    compared[3].save(tmp_path / "evaluation.json")
    content = json.loads((tmp_path / "evaluation.json").read_text())
    assert list(content) == ["schema", "pairs", "measurements"]
    assert content["schema"] == "planish.evaluation/1"
    keys = ["a", "b", "overlap", "rotation_error_rad", "tangential_rms_mm", "normal_rms_mm", "nees"]
    assert all(list(pair) == keys for pair in content["pairs"])
    keys = ["name", "tangential_rms_mm", "normal_rms_mm", "nees"]
    assert all(list(m) == keys for m in content["measurements"])


def entry(**changes):
    return {"name": "a", "part": "1", "T_object_sensor": np.eye(4).tolist()} | changes


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"schema": "planish.truth/2", "measurements": [entry()]}, "schema"),
        ({"schema": "planish.truth/1", "measurements": []}, "measurements"),
        ({"schema": "planish.truth/1", "measurements": [entry(pose=1)]}, "unknown key"),
        ({"schema": "planish.truth/1", "measurements": [entry(), entry()]}, "twice"),
        ({"schema": "planish.truth/1", "measurements": [entry(T_object_sensor=np.ones((4, 4)).tolist())]}, "rigid"),
    ],
)
def test_an_unusable_truth_file_is_refused(tmp_path, content, message):
    storage.write_json(tmp_path / "truth.json", content)
    with pytest.raises(InputError, match=message):
        Truth.load(tmp_path / "truth.json")


def test_truth_must_know_every_measurement(compared):
    result, truth, items, _ = compared
    known = {name: place for name, place in truth.places.items() if name != "right"}
    with pytest.raises(InputError, match="right"):
        compare_with_truth(result, Truth(known), items)
