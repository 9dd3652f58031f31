"""A small registered run with known truth, for the tests of evaluation, files and report."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import synthetic
from planish import storage
from planish.evaluation.overlap import evaluate_overlap
from planish.evaluation.prepared import Prepared
from planish.evaluation.truth import TruePlace, Truth
from planish.geometry import exp_se3, invert, perturb, transform_points
from planish.registration.result import (
    Direction,
    Group,
    PairResult,
    PlacedMeasurement,
    Registration,
    RunnerUp,
)

#: Standard deviations of the drawn errors [rad, mm].
SIGMAS = np.array([2e-5] * 3 + [0.004] * 3)
COVARIANCE = np.diag(SIGMAS**2)
NAMES = ("left", "middle", "right", "other <part>")


@cache
def prepared():
    """Four measurements: three in a row on one sheet, each overlapping the next, and one of another part."""
    sheet = synthetic.raster(1, 0.03)
    places = {
        "left": exp_se3([0, 0, 0.05, -150, 0, 0]),
        "middle": exp_se3([0.02, 0, 0, 0, 10, 0]),
        "right": exp_se3([0, -0.02, -0.1, 175, 0, 0]),
        "other <part>": np.eye(4),
    }
    items = {
        name: Prepared(synthetic.measurement(T, sheet, name=name, scale=0.2, bend=1 / 900, seed=i))
        for i, (name, T) in enumerate(places.items())
    }
    parts = {name: "2" if name.startswith("other") else "1" for name in places}
    return items, Truth({name: TruePlace(parts[name], T) for name, T in places.items()})


def draw(T_true, point, rng):
    """A transform with an error of COVARIANCE about `point`: perturb(T_hat, xi, point) = T_true."""
    return perturb(T_true, -SIGMAS * rng.standard_normal(6), point)


def registration(seed=0):
    """Errors of known covariance; (left, middle) and (middle, right) accepted, the rest refused."""
    items, truth = prepared()
    rng = np.random.default_rng(seed)
    pairs, evaluations = [], []
    for i, a in enumerate(NAMES):
        for b in NAMES[i + 1 :]:
            if (a, b) not in (("left", "middle"), ("middle", "right")):
                reason = "5 of 143 matches agree: <as many as chance gives> [no consensus]"
                pairs.append(PairResult(a, b, "refused", reason, matches=143, consensus=5))
                continue
            point = np.array([30.0, 10.0, 0.0])
            T_hat = draw(truth.transform(a, b), point, rng)
            found = evaluate_overlap(items[a], items[b], T_hat)
            evaluations.append(found)
            rows = np.argwhere(np.isfinite(found.distance_of_a_mm))[::700]
            points = items[a].measurement.points_sensor[tuple(rows.T)]
            ends = items[b].measurement.camera.project(transform_points(invert(T_hat), points))
            consensus = np.hstack([rows[:, ::-1], ends])
            matches = np.vstack([consensus, consensus[::4] + [3, 0, 20, -9]])
            directions = tuple(Direction(tuple(row), 90.0, 0.004, 0.7, True, "a shift") for row in np.eye(6))
            pairs.append(
                PairResult(
                    a, b, "accepted", "consensus far above chance", T_hat, COVARIANCE, None, point, len(matches),
                    len(consensus), -120.0, RunnerUp(7, -0.5, T_hat, 0.3, 40.0), directions, found.overlap,
                    found.error, True, None, consensus, matches,
                )
            )  # fmt: skip
    placed = []
    for name in NAMES:
        group = int(name.startswith("other"))
        reference = name if group else "left"
        T_true = truth.transform(reference, name)
        point = transform_points(T_true, np.nanmean(items[name].measurement.points_sensor, (0, 1)).astype(float))
        exact = name == reference
        placed.append(
            PlacedMeasurement(
                name, f"{name}.h5", "0" * 64, group, T_true if exact else draw(T_true, point, rng),
                np.zeros((6, 6)) if exact else COVARIANCE, None, point,
            )
        )  # fmt: skip
    groups = (Group(0, "left"), Group(1, NAMES[3]))
    return Registration(groups, tuple(placed), tuple(pairs), {"an": "option"}, {"planish": "0.1.0"}), evaluations


def write_run(folder, seed=0):
    """Write measurements, registration.json, run.json and truth.json to `folder`; return the registration."""
    items, truth = prepared()
    result, _ = registration(seed)
    files = {name: folder / f"measurement_{i}.h5" for i, name in enumerate(NAMES)}
    for name, path in files.items():
        items[name].measurement.save(path)
    placed = tuple(
        replace(m, file=files[m.name].name, sha256=storage.sha256(files[m.name])) for m in result.measurements
    )
    result = replace(result, measurements=placed)
    result.save(folder / "registration.json")
    storage.write_json(folder / "run.json", {"measurements": {name: str(path) for name, path in files.items()}})
    entries = [
        {"name": name, "part": place.part, "T_object_sensor": place.T_object_sensor.tolist()}
        for name, place in truth.places.items()
    ]
    storage.write_json(folder / "truth.json", {"schema": "planish.truth/1", "measurements": entries})
    return result
