"""From figures to a verdict: holds, does not hold, or not observable; why, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planish.measurement import Finding
from planish.sensing.rigcheck.estimates import MAX_LEFT_PX, Pattern
from planish.sensing.rigcheck.result import MeasurementRows, OrientationError, RigCheck, Status

#: What the row error (rms over the image) of a rig without covariance may be [px].
LIMIT_PX = 0.1
#: A rig is said not to hold beyond so many standard deviations.
SIGMAS = 4.0
#: Where the mean row error is known less well than this share of the limit, nothing is said to hold.
KNOWN_SHARE = 0.5
#: A rig without covariance does not hold where the orientation moves the points by more than this share of their
#: distance, however small the row errors.
MOVED_SHARE = 5e-4
#: A pattern that no orientation explains is told above this [px].
LENS_PX = 0.05
#: Projector and cameras may disagree by so much [projector px], as in the warnings of measurements.
PROJECTOR_PX = 1.0


@dataclass(frozen=True)
class Figures:
    """What the row errors of all measurements together say; as in RigCheck."""

    pattern: Pattern
    noise_sigmas: float
    rig_sigmas: float | None
    allowed_px: float
    row_mm: float
    distance_mm: float
    orientation: OrientationError
    unexplained_px: float
    unexplained_sigmas: float


def judge(rows: Sequence[MeasurementRows], figures: Figures | None) -> RigCheck:
    """Return the verdict; `figures` None where no row errors are observable."""
    stored = [finding for item in rows for finding in item.stored]
    if figures is None:
        status, reason = _by_stored(stored, rows)
    else:
        status, reason = _by_rows(figures)
        contradiction = _contradiction([item for item in stored if not item.quantity.startswith("row error of")])
        if contradiction and status != "does not hold":
            status, reason = "does not hold", contradiction
    p = None if figures is None else figures.pattern
    return RigCheck(
        status=status,
        reason=reason,
        measurements=tuple(rows),
        mean_px=None if p is None else p.mean_px,
        sigma_px=None if p is None else p.sigma_px,
        variation_px=None if p is None else p.variation_px,
        rms_px=None if p is None else p.rms_px,
        rms_sigma_px=None if p is None else p.rms_sigma_px,
        noise_sigmas=None if figures is None else figures.noise_sigmas,
        rig_sigmas=None if figures is None else figures.rig_sigmas,
        allowed_px=LIMIT_PX if figures is None else figures.allowed_px,
        row_mm=None if figures is None else figures.row_mm,
        distance_mm=None if figures is None else figures.distance_mm,
        orientation=None if figures is None else figures.orientation,
        unexplained_px=None if figures is None else figures.unexplained_px,
        unexplained_sigmas=None if figures is None else figures.unexplained_sigmas,
        not_observable=_not_observable(figures, stored),
        advice=_advice(status, figures),
    )


def _by_rows(f: Figures) -> tuple[Status, str]:
    p = f.pattern
    if f.rig_sigmas is not None:
        against = f"the rig's covariance allows {f.allowed_px:.2g} px"
        beyond = f.rig_sigmas > SIGMAS
        limit = max(f.allowed_px, LIMIT_PX)
    else:
        against = f"the limit for a rig without covariance is {LIMIT_PX} px"
        beyond = p.rms_px - LIMIT_PX > SIGMAS * p.rms_sigma_px
        limit = LIMIT_PX
        # Convergence makes small row errors and large errors of depth.
        if f.orientation.sigmas > SIGMAS and f.orientation.moves_mm > MOVED_SHARE * f.distance_mm and not beyond:
            return "does not hold", (
                f"the orientation that explains the row errors ({f.orientation.sigmas:.1f} standard deviations) moves "
                f"the points by {f.orientation.moves_mm:.2g} mm"
            )
    said = f"row error {p.rms_px:.2f} +- {p.rms_sigma_px:.2f} px, rms over the image; {against}"
    if beyond:
        return "does not hold", said
    if p.sigma_px > KNOWN_SHARE * limit:
        return "not observable", f"only a row error above {SIGMAS * p.sigma_px:.2g} px would be seen"
    return "holds", said


def _by_stored(stored: Sequence[Finding], rows: Sequence[MeasurementRows]) -> tuple[Status, str]:
    """Return the verdict by what the files say, where their images tell nothing."""
    contradiction = _contradiction(stored)
    if contradiction:
        return "does not hold", contradiction
    # That a projector's stripes agree with the cameras says nothing of rows: they run along the stripes.
    known = [item for item in stored if item.value is not None and item.quantity.startswith("row error")]
    if not known:
        return "not observable", "; ".join(dict.fromkeys(item.source for item in rows))
    return "holds", "; ".join(f"{item} (stored in the file)" for item in known)


def _contradiction(stored: Sequence[Finding]) -> str:
    """Return the first finding that contradicts the rig, in words; empty without one."""
    for item in stored:
        if item.value is None:
            continue
        limit = LIMIT_PX if item.unit == "px" else PROJECTOR_PX
        if item.warning or abs(item.value) - SIGMAS * (item.sigma or 0.0) > limit:
            return f"{item} (stored in the file)"
    return ""


def _not_observable(figures: Figures | None, stored: Sequence[Finding]) -> tuple[str, ...]:
    told = ["the length of the baseline, and with it the scale of all points"]
    if figures is None:
        told.append("the direction of the baseline and the orientation of the devices to each other")
    else:
        o = figures.orientation
        index = o.names.index(o.unseen_name)
        sigma = float(np.degrees(np.sqrt(o.covariance[index, index])))
        told.append(
            f"{o.unseen_name} better than +- {sigma:.2g} deg, and with it where the points are better than "
            f"+- {o.unseen_mm:.2g} mm (rms)"
        )
        told.append("errors of the principal distances and lenses that move points along the epipolar lines")
    for item in stored:
        if item.quantity == "projector against cameras" and item.value is not None:
            told.append(f"but the projector, a third device, tells of these: {item}")
            break
    return tuple(told)


def _advice(status: Status, f: Figures | None) -> tuple[str, ...]:
    if status == "holds":
        return ()
    if status == "not observable":
        return (
            "measure parts with more texture, in more of the image, and give several measurements",
            "or project both axes and give the captures: they need no texture",
        )
    if f is None:
        return ("calibrate again",)
    said = []
    if f.unexplained_sigmas > SIGMAS and f.unexplained_px > LENS_PX:
        said.append(
            f"calibrate again: {f.unexplained_px:.2f} px of the pattern over the image are no orientation's; lenses, "
            "principal distances or the assignment of images and rig are at fault"
        )
    if f.unexplained_px <= MAX_LEFT_PX:
        said.append("adjust the relative orientation (--adjust), measure again with the new rig and check again")
        said.append("calibrate again where depth counts: what row errors do not see stays as it was")
    return tuple(said)
