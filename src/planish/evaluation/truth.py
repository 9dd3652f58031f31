"""Comparison of a registration with the truth of simulated or independently measured captures (`truth.json`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish import storage
from planish.errors import InputError
from planish.evaluation.overlap import overlap_fraction, signed_distances
from planish.evaluation.prepared import Prepared
from planish.evaluation.result import Evaluation, MeasurementError, PairError
from planish.geometry import Array, difference, invert, require_rigid, rotation_angle, transform_points
from planish.measurement import Map
from planish.options import Strict
from planish.registration.result import PairResult, PlacedMeasurement, Registration

SCHEMA = "planish.truth/1"

#: A pair of one part with at least this overlap that is not accepted counts as missing.
MISSING_OVERLAP = 0.3
#: An accepted transform with a larger error (root mean square over the true overlap) is wrong, not just inexact [mm].
WRONG_MM = 1.0


class _TrueMeasurement(Strict):
    name: str = Field(min_length=1)
    part: str | int
    T_object_sensor: list[list[float]]


class _TruthFile(Strict):
    schema_: Literal["planish.truth/1"] = Field(alias="schema")
    measurements: list[_TrueMeasurement] = Field(min_length=1)


@dataclass(frozen=True)
class TruePlace:
    """True place of one measurement: T_object_sensor maps its sensor frame into the frame of its part."""

    part: str
    T_object_sensor: Array


@dataclass(frozen=True)
class Truth:
    """True places by name of the measurement."""

    places: dict[str, TruePlace]

    @classmethod
    def load(cls, path: Path) -> Truth:
        """Read `truth.json`; errors name the file."""
        content = _TruthFile.parse(storage.read_json(Path(path)), str(path))
        places: dict[str, TruePlace] = {}
        for item in content.measurements:
            if item.name in places:
                raise InputError(path, f"names the measurement '{item.name}' twice", "each name once")
            T = require_rigid(item.T_object_sensor, f"{path}: {item.name}: T_object_sensor")
            places[item.name] = TruePlace(str(item.part), T)
        return cls(places)

    def require(self, names: list[str], subject: str) -> None:
        """Raise an error that names `subject` unless all `names` have a true place."""
        missing = [name for name in names if name not in self.places]
        if missing:
            raise InputError(subject, f"has no measurement {missing}", f"all of {names}")

    def same_part(self, a: str, b: str) -> bool:
        """Return whether two measurements show the same part."""
        return self.places[a].part == self.places[b].part

    def transform(self, a: str, b: str) -> Array:
        """Return the true T_a_b (4, 4) of two measurements of one part."""
        return invert(self.places[a].T_object_sensor) @ self.places[b].T_object_sensor


def compare_with_truth(
    registration: Registration, truth: Truth, measurements: Mapping[str, Prepared], threads: int | None = None
) -> Evaluation:
    """Return the errors of all accepted pairs and of all measurements, and what is wrong or missing.

    Parameters
    ----------
    registration : Registration
        The result to be judged.
    truth : Truth
        True places of all its measurements.
    measurements : mapping of Prepared
        Its measurements by name.
    threads : int or None
        Number of threads.
    """
    truth.require([m.name for m in registration.measurements], "truth")
    findings: list[str] = []
    pairs = tuple(
        _pair_error(pair, truth, measurements, findings, threads)
        for pair in registration.pairs
        if pair.status == "accepted" and pair.T_a_b is not None
    )
    by_name = {m.name: m for m in registration.measurements}
    references = {group.id: by_name[group.reference] for group in registration.groups}
    placed = tuple(
        _measurement_error(m, references[m.group], truth, measurements[m.name], findings)
        for m in registration.measurements
    )
    findings += _missing_pairs(registration, truth, measurements, threads)
    return Evaluation(pairs, placed, tuple(findings))


def true_overlap(a: Prepared, b: Prepared, T_a_b: Array, threads: int | None = None) -> tuple[float, NDArray[np.bool_]]:
    """Return the overlap under a true transform and which pixels (H, W) of b lie in it."""
    if not _Extent.of(a).touches(_Extent.of(b), T_a_b):
        return 0.0, np.zeros(b.measurement.shape, bool)
    of_b, _ = signed_distances(a, b, T_a_b, threads=threads)
    of_a, _ = signed_distances(b, a, invert(T_a_b), threads=threads)
    return overlap_fraction(a, b, of_a), np.isfinite(of_b)


def error_rms(T_hat: Array, T_true: Array, item: Prepared, pixels: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Return the rms of e = (T_hat - T_true) x along the surface and along its normal [mm] over some pixels (H, W)."""
    pixels = pixels & np.isfinite(item.surface.normals_sensor[..., 0])
    if not pixels.any():
        return None
    points = item.measurement.points_sensor[pixels].astype(float)
    normals = item.surface.normals_sensor[pixels].astype(float) @ T_true[:3, :3].T
    e = transform_points(T_hat, points) - transform_points(T_true, points)
    e_n = np.einsum("ki,ki->k", e, normals)
    e_t = e - e_n[:, None] * normals
    return float(np.sqrt((e_t**2).sum(1).mean())), float(np.sqrt((e_n**2).mean()))


def nees(
    T_hat: Array, T_true: Array, point: Array | None, noise: Array | None, calibration: Array | None
) -> float | None:
    """Return xi' C^-1 xi (6 degrees of freedom), C the sum of both covariances; None where there is no such C."""
    if noise is None or point is None:
        return None
    covariance = noise if calibration is None else noise + calibration
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    xi = difference(T_true, T_hat, point)
    return float(xi @ np.linalg.solve(covariance, xi))


def _pair_error(
    pair: PairResult,
    truth: Truth,
    measurements: Mapping[str, Prepared],
    findings: list[str],
    threads: int | None,
) -> PairError:
    assert pair.T_a_b is not None
    if not truth.same_part(pair.a, pair.b):
        findings.append(f"WRONG: {pair.a}, {pair.b} accepted, but they show different parts")
        return PairError(pair.a, pair.b, 0.0)
    T_true = truth.transform(pair.a, pair.b)
    a, b = measurements[pair.a], measurements[pair.b]
    overlap, pixels = true_overlap(a, b, T_true, threads)
    if not pixels.any():
        findings.append(f"WRONG: {pair.a}, {pair.b} accepted, but they do not overlap")
    rms = error_rms(pair.T_a_b, T_true, b, pixels)
    if rms is not None and np.hypot(*rms) > WRONG_MM:
        findings.append(f"WRONG: {pair.a}, {pair.b} accepted with an error of {np.hypot(*rms):.2f} mm")
    tangential, normal = rms or (None, None)
    return PairError(
        pair.a, pair.b, overlap, rotation_angle(invert(T_true) @ pair.T_a_b), tangential, normal,
        nees(pair.T_a_b, T_true, pair.covariance_point_mm, pair.covariance_noise, pair.covariance_calibration),
    )  # fmt: skip


def _measurement_error(
    placed: PlacedMeasurement, reference: PlacedMeasurement, truth: Truth, item: Prepared, findings: list[str]
) -> MeasurementError:
    if not truth.same_part(reference.name, placed.name):
        findings.append(f"WRONG: {placed.name} is tied to {reference.name}, but they show different parts")
        return MeasurementError(placed.name)
    T_true = truth.transform(reference.name, placed.name)
    # The world may be a frame given from outside, of which the truth knows nothing.
    T_hat = invert(reference.T_world_measurement) @ placed.T_world_measurement
    tangential, normal = error_rms(T_hat, T_true, item, item.measurement.valid) or (None, None)
    # Covariances are relative to the reference only where it is the datum.
    noise = None if placed.name == reference.name or reference.covariance_noise.any() else placed.covariance_noise
    value = nees(T_hat, T_true, placed.covariance_point_mm, noise, placed.covariance_calibration)
    return MeasurementError(placed.name, tangential, normal, value)


def _missing_pairs(
    registration: Registration, truth: Truth, measurements: Mapping[str, Prepared], threads: int | None
) -> list[str]:
    accepted = {frozenset((p.a, p.b)) for p in registration.pairs if p.status == "accepted"}
    found = []
    # Each measurement is asked for once, and again only where two come near each other.
    extents = {m.name: _Extent.of(measurements[m.name]) for m in registration.measurements}
    for a, b in combinations(extents, 2):
        if frozenset((a, b)) in accepted or not truth.same_part(a, b):
            continue
        if not extents[a].touches(extents[b], truth.transform(a, b)):
            continue
        overlap, _ = true_overlap(measurements[a], measurements[b], truth.transform(a, b), threads)
        if overlap >= MISSING_OVERLAP:
            found.append(f"missing: {a}, {b} overlap by {overlap:.0%}, but are not accepted")
    return found


@dataclass(frozen=True)
class _Extent:
    """Points (N, 3) of every 4th row and column, and the size of a pixel [mm]."""

    points: Map
    gsd_mm: float

    @classmethod
    def of(cls, item: Prepared) -> _Extent:
        points = item.measurement.points_sensor[::4, ::4].reshape(-1, 3)
        return cls(points[np.isfinite(points[:, 2])], item.gsd_mm)

    def touches(self, b: _Extent, T_a_b: Array) -> bool:
        """Return whether the axis-parallel boxes of this and of b, moved into its frame, come within a millimetre."""
        if not len(self.points) or not len(b.points):
            return True
        # A margin for what lies between the points: this only saves the look-ups of pairs far apart.
        margin = 1.0 + 8 * max(self.gsd_mm, b.gsd_mm)
        points = self.points.astype(float), transform_points(T_a_b, b.points.astype(float))
        low, high = [p.min(0) for p in points], [p.max(0) for p in points]
        return bool(np.all(low[0] <= high[1] + margin) and np.all(low[1] <= high[0] + margin))
