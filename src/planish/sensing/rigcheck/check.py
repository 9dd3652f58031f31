"""Does the calibration still hold? Row errors of one or several measurements against noise and the rig's covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from planish.geometry import Array
from planish.measurement import Measurement
from planish.rig import Rig
from planish.sensing.rigcheck.estimates import (
    Orientation,
    Pattern,
    estimate_orientation,
    points_by_orientation,
    slow_pattern,
    unexplained,
    with_lens_errors,
)
from planish.sensing.rigcheck.evidence import Evidence, gather
from planish.sensing.rigcheck.orientation import CHANGES, moved_device, orientation_basis, reoriented
from planish.sensing.rigcheck.pairs import PixelPairs, row_errors
from planish.sensing.rigcheck.places import MIN_PLACES
from planish.sensing.rigcheck.result import MeasurementRows, OrientationError, RigCheck
from planish.sensing.rigcheck.same_rig import common_rig, in_frame
from planish.sensing.rigcheck.textures import pairs_by_texture
from planish.sensing.rigcheck.verdict import LIMIT_PX, Figures, judge

#: What a measurement says about its rig by other evidence.
STORED = ("row error", "projector against cameras", "miss of the projector")


def collect_pairs(
    measurements: Mapping[str, Measurement], better: Mapping[str, PixelPairs] | None = None
) -> dict[str, PixelPairs]:
    """Return per measurement where its cameras see the same points, in the sensor frame of the first one's rig.

    Parameters
    ----------
    measurements : mapping of Measurement
        By the name of their files.
    better : mapping of PixelPairs
        Pairs that are known otherwise, for example from a second projector axis; they replace those by texture.

    Raises
    ------
    InputError
        Where the measurements are not of one rig.
    """
    rig = common_rig(measurements)
    found = {}
    for name, measurement in measurements.items():
        pairs = (better or {}).get(name)
        if pairs is None:
            pairs = pairs_by_texture(measurement)
        if pairs is not None:
            found[name] = in_frame(pairs, measurement.rig, rig)
    return found


def check_rig_by(measurements: Mapping[str, Measurement], pairs: Mapping[str, PixelPairs]) -> RigCheck:
    """Return whether the calibration of the measurements still holds.

    Parameters
    ----------
    measurements : mapping of Measurement
        By the name of their files; all of one rig.
    pairs : mapping of PixelPairs
        Of `collect_pairs`.
    """
    rig = common_rig(measurements)
    rows = tuple(_rows(name, m, pairs.get(name), rig) for name, m in measurements.items())
    together = usable(pairs)
    if not together:
        return judge(rows, None)
    evidence = evidence_of(together, rig)
    pattern = slow_pattern(evidence)
    by_noise = estimate_orientation(with_lens_errors(evidence, rig), None)
    noise_sigmas = max(estimate_orientation(evidence, None).sigmas, unexplained(evidence, None)[1])
    left_px, left_sigmas = unexplained(evidence, rig)
    points = np.concatenate([item.points_sensor for item in together])
    own = rig.devices[together[0].own]
    distance = float(np.median(np.linalg.norm(points - own.center_sensor, axis=1)))
    figures = Figures(
        pattern=pattern,
        noise_sigmas=noise_sigmas,
        rig_sigmas=None if rig.covariance is None else max(estimate_orientation(evidence, rig).sigmas, left_sigmas),
        allowed_px=_allowed(rig, evidence),
        row_mm=distance / float(rig.devices[together[0].other].K[1, 1]),
        distance_mm=distance,
        orientation=_orientation_error(together, rig, by_noise),
        unexplained_px=left_px,
        unexplained_sigmas=left_sigmas,
    )
    return judge(rows, figures)


def usable(pairs: Mapping[str, PixelPairs]) -> list[PixelPairs]:
    """Return the pairs of measurements that show enough places, all of the devices that most of them show."""
    enough = [item for item in pairs.values() if len(item) >= MIN_PLACES]
    devices = [frozenset((item.own, item.other)) for item in enough]
    if not devices:
        return []
    most = max(devices, key=lambda names: sum(len(i) for i, d in zip(enough, devices, strict=True) if d == names))
    return [item for item, names in zip(enough, devices, strict=True) if names == most]


def evidence_of(pairs: Sequence[PixelPairs], rig: Rig) -> Evidence:
    """Return the row errors of all pairs by the rig, differentiated by the parameters of its covariance."""
    return gather(pairs, rig, rig.covariance_parameters if rig.covariance is not None else ())


def _allowed(rig: Rig, evidence: Evidence) -> float:
    if rig.covariance is None:
        return LIMIT_PX
    return float(np.sqrt(((evidence.by_rig @ rig.modes().T) ** 2).sum(1).mean()))


def _rows(name: str, measurement: Measurement, pairs: PixelPairs | None, rig: Rig) -> MeasurementRows:
    stored = tuple(item for item in measurement.findings if item.quantity.startswith(STORED))
    other = rig.other(measurement.organised_on) or "projector"
    if pairs is None or len(pairs) < MIN_PLACES:
        source, searched = _why_none(measurement, pairs), 0 if pairs is None else pairs.searched
        empty: Array = np.empty(0)
        return MeasurementRows(
            name, source, other, searched, None, None, None, np.empty((0, 2)), empty, empty, stored
        )  # fmt: skip
    evidence = evidence_of([pairs], rig)
    pattern: Pattern = slow_pattern(evidence)
    return MeasurementRows(
        name, pairs.source, pairs.other, pairs.searched, pattern.mean_px, pattern.sigma_px, pattern.variation_px,
        pairs.own_px, evidence.error_px, evidence.sigma_px, stored,
    )  # fmt: skip


def _why_none(measurement: Measurement, pairs: PixelPairs | None) -> str:
    if pairs is not None:
        return f"{pairs.source}: {len(pairs)} of {pairs.searched} places show enough texture"
    if measurement.correspondence_px is None:
        return "no correspondences between two cameras in the file"
    return "too few correspondences or images"


def _orientation_error(pairs: Sequence[PixelPairs], rig: Rig, found: Orientation) -> OrientationError:
    moved, fixed = moved_device(pairs[0].own, pairs[0].other)
    changed = reoriented(rig, moved, fixed, orientation_basis(rig, moved, fixed) @ found.change_rad)
    before = np.concatenate([row_errors(_as_matched(item), rig).points_sensor for item in pairs])
    after = np.concatenate([row_errors(item, changed).points_sensor for item in pairs])
    moves = float(np.sqrt(np.median(((after - before) ** 2).sum(1))))
    D = points_by_orientation(pairs, rig)
    values, vectors = np.linalg.eigh(found.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))
    per_change = np.einsum("nik,nil->kl", D, D) / len(D)
    size, modes = np.linalg.eigh(root.T @ per_change @ root)
    worst = root @ modes[:, -1]
    name = CHANGES[int(np.argmax(np.abs(worst) * np.sqrt(np.diag(per_change))))]
    return OrientationError(
        moved, fixed, CHANGES, found.change_rad, found.covariance, found.sigmas, moves, float(np.sqrt(size.sum())), name
    )  # fmt: skip


def _as_matched(pairs: PixelPairs) -> PixelPairs:
    return pairs.with_other(pairs.matched_px)
