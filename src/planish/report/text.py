"""What the report says in words: the verdict of a run and of a pair."""

from __future__ import annotations

import numpy as np

from planish.geometry import rotation_angle
from planish.registration.result import PairResult, PlacedMeasurement, Registration

#: Largest share of a pair's overlap error along the surface, over what noise explains, that passes without remark.
NOTEWORTHY = 2.0


def count(number: int, what: str) -> str:
    """Return "1 pair", "2 pairs"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def verdict(registration: Registration) -> tuple[str, list[str]]:
    """Return a class ("", "partial", "none") and the sentences of the summary, the most important one first."""
    sizes = {g.id: [m.name for m in registration.measurements if m.group == g.id] for g in registration.groups}
    groups = sorted(sizes.values(), key=len, reverse=True)
    total = len(registration.measurements)
    if not groups or total == 0:
        return "none", ["There is nothing to register."]
    if len(groups[0]) == total and total > 1:
        kind, first = "", f"All {total} measurements are tied into one part."
    elif len(groups[0]) > 1:
        kind, first = "partial", f"{len(groups[0])} of {total} measurements are tied together."
    else:
        kind, first = "none", "No measurement could be tied to another one."
    sentences = [first]
    loose = [names for names in groups[1:] if len(names) == 1]
    if loose and len(groups[0]) > 1:
        sentences.append("Not tied in: " + ", ".join(names[0] for names in loose) + ".")
    sentences += ["A group of its own: " + ", ".join(names) + "." for names in groups[1:] if len(names) > 1]
    sentences.append(_pairs(registration))
    return kind, [s for s in [*sentences, _agreement(registration), _certainty(registration)] if s]


def _pairs(registration: Registration) -> str:
    by_status = {s: [p for p in registration.pairs if p.status == s] for s in ("accepted", "refused", "ambiguous")}
    text = f"{count(len(by_status['accepted']), 'pair')} accepted, {len(by_status['refused'])} refused"
    if by_status["ambiguous"]:
        text += f", {len(by_status['ambiguous'])} ambiguous"
    removed = [p for p in by_status["accepted"] if not p.used]
    if removed:
        text += f"; {len(removed)} of the accepted left out of the network"
    return text + "."


def _agreement(registration: Registration) -> str:
    errors = [p.overlap_error for p in registration.pairs if p.overlap_error is not None]
    if not errors:
        return ""
    text = f"Overlapping surfaces agree within {max(e.rms_normal_mm for e in errors):.3f} mm rms along the normal"
    along = [e.rms_tangential_mm for e in errors if e.rms_tangential_mm is not None]
    if along:
        text += f" and {max(along):.3f} mm rms along the surface (largest of all pairs, noise included)"
    return text + "."


def _certainty(registration: Registration) -> str:
    sigmas = [position_sigma(m) for m in registration.measurements]
    if max(sigmas, default=0.0) == 0.0:
        return ""
    calibrated = any(m.covariance_calibration is not None for m in registration.measurements)
    source = "from noise and calibration" if calibrated else "from noise alone: the rig states no covariance"
    return f"A measurement's place has a standard deviation of up to {max(sigmas):.4f} mm ({source})."


def position_sigma(placed: PlacedMeasurement) -> float:
    """Return the standard deviation of the place of a measurement's centroid, all three directions together [mm]."""
    covariance = placed.covariance_noise
    if placed.covariance_calibration is not None:
        covariance = covariance + placed.covariance_calibration
    return float(np.sqrt(max(0.0, np.trace(covariance[3:, 3:]))))


def rotation_sigma(placed: PlacedMeasurement) -> float:
    """Return the standard deviation of the rotation of a measurement, all three axes together [rad]."""
    covariance = placed.covariance_noise
    if placed.covariance_calibration is not None:
        covariance = covariance + placed.covariance_calibration
    return float(np.sqrt(max(0.0, np.trace(covariance[:3, :3]))))


def remarks(pair: PairResult) -> list[str]:
    """Return what a reader of an accepted pair must not overlook."""
    out = []
    if pair.removed_reason:
        out.append(f"Left out of the network: {pair.removed_reason}")
    weak = [d for d in pair.observability if not d.observable]
    if weak:
        out += [f"{d.motion[:1].upper()}{d.motion[1:]}: {d.held_by}." for d in weak]
    error = pair.overlap_error
    if error is not None and error.rms_tangential_mm is not None and error.sigma_tangential_mm is not None:
        if error.rms_tangential_mm > NOTEWORTHY * error.sigma_tangential_mm:
            out.append(
                f"The texture is shifted along the surface by {error.rms_tangential_mm:.3f} mm rms, more than its "
                f"noise of {error.sigma_tangential_mm:.3f} mm explains."
            )
    elif error is not None:
        out.append("The error along the surface could not be measured: too little texture in the tiles kept out.")
    return out


def motion(pair: PairResult) -> str:
    """Return the size of T_a_b in words."""
    if pair.T_a_b is None:
        return ""
    angle = np.degrees(rotation_angle(pair.T_a_b))
    return f"rotation {angle:.3f}°, translation {np.linalg.norm(pair.T_a_b[:3, 3]):.2f} mm"
