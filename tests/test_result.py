"""registration.json: nothing lost on the way, and what contradicts itself is refused by file and key."""

import json

import numpy as np
import pytest

from planish import geometry
from planish.errors import InputError
from planish.registration.result import (
    Direction,
    Group,
    OverlapError,
    PairResult,
    PlacedMeasurement,
    Registration,
    RunnerUp,
)


def placed(name, group, T):
    point = np.array([1.0, 2.0, 3.0])
    return PlacedMeasurement(name, f"{name}.h5", "ab" * 32, group, T, 1e-6 * np.eye(6), None, point)


def make_registration():
    T = geometry.exp_se3([0.1, 0.2, -0.3, 10.0, 20.0, -5.0])
    accepted = PairResult(
        "door_1", "door_2", "accepted", "enough agreement",
        T, 1e-6 * np.eye(6), 1e-5 * np.eye(6), np.array([3.0, 2.0, 1.0]),
        344, 82, -120.5, RunnerUp(5, 0.3, geometry.invert(T), 0.4, 30.0),
        (Direction((0.0, 0, 0, 1, 0, 0), 150.0, 0.002, 0.9, True, "a shift"),), 0.4,
        OverlapError(10_000, -0.1, 0.2, 0.004, 0.01, 0.002), True,
    )  # fmt: skip
    refused = PairResult("door_1", "door_3", "refused", "too few matches", matches=3)
    measurements = (placed("door_1", 0, np.eye(4)), placed("door_2", 0, T), placed("door_3", 1, np.eye(4)))
    groups = (Group(0, "door_1"), Group(1, "door_3"))
    return Registration(groups, measurements, (accepted, refused), {"window_px": 5}, {"planish": "0.1.0"})


def test_a_registration_survives_its_file(tmp_path):
    registration = make_registration()
    registration.save(tmp_path / "registration.json")
    loaded = Registration.load(tmp_path / "registration.json")
    assert loaded.to_json() == registration.to_json()
    np.testing.assert_array_equal(loaded.pairs[0].T_a_b, registration.pairs[0].T_a_b)
    assert loaded.pairs[0].runner_up.T_a_b.shape == (4, 4)
    assert loaded.pairs[0].observability == registration.pairs[0].observability
    assert loaded.pairs[1].T_a_b is None
    assert loaded.groups == registration.groups


def test_a_pair_is_found_by_its_names_and_a_wrong_name_is_refused():
    registration = make_registration()
    assert registration.pair("door_1", "door_3").reason == "too few matches"
    with pytest.raises(InputError, match="door_9"):
        registration.pair("door_1", "door_9")


def change_pair(index, **values):
    return lambda content: content["pairs"][index].update(values)


def change_measurement(index, **values):
    return lambda content: content["measurements"][index].update(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_pair(1, T_a_b=np.eye(4).tolist()), "status 'refused' with a T_a_b"),
        (change_pair(0, T_a_b=None), "status 'accepted' with no T_a_b"),
        (change_pair(0, T_a_b=(2 * np.eye(4)).tolist()), "pair door_1, door_2: T_a_b"),
        (change_pair(0, covariance_noise=[[1.0]]), "pair door_1, door_2: covariance_noise"),
        (change_pair(0, status="good"), "'pairs.0.status' is 'good'"),
        (change_pair(0, extra=1), "unknown key 'pairs.0.extra'"),
        (change_pair(0, b="door_9"), "unknown measurements ['door_9']"),
        (change_measurement(1, covariance_noise=[[1.0, 2.0], [3.0]]), "door_2: covariance_noise"),
        (change_measurement(1, T_world_measurement=[[1.0]]), "door_2: T_world_measurement"),
        (change_measurement(1, name="door_1"), "unknown measurements ['door_2']"),
        (change_measurement(1, group=7), "groups and measurements do not fit"),
        (lambda content: content.pop("units"), "key 'units' is missing"),
    ],
)
def test_a_contradictory_registration_is_refused_by_file_and_key(tmp_path, change, message):
    content = make_registration().to_json()
    change(content)
    path = tmp_path / "registration.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        Registration.load(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
