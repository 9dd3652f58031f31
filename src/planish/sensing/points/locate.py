"""Points of the organising camera's pixels, by whichever devices of the rig see them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.measurement import Finding, Map, rejection_bit
from planish.rig import Camera, Rig
from planish.sensing.capture.manifest import Box
from planish.sensing.decode import PhaseMap
from planish.sensing.observe import Observation
from planish.sensing.patterns.entries import Axis
from planish.sensing.points.agreement import Agreement, measure_agreement, sample_pixels, systematic_miss
from planish.sensing.points.axes import axis_between_cameras, axis_to_projector
from planish.sensing.points.correlate import CorrelateOptions, correlate
from planish.sensing.points.correspond import correspond
from planish.sensing.points.projector import intersect
from planish.sensing.points.reject import RejectOptions
from planish.sensing.points.triangulate import TriangulatedPoints, triangulate

Geometry = Literal["auto", "stereo", "projector"]
#: Missing pixels stand in lists of this width.
LIST_WIDTH = 512


@dataclass(frozen=True)
class Located:
    """Points, and what they rest on.

    Parameters
    ----------
    points : TriangulatedPoints
        On the pixel grid (H, W) of the organising camera.
    phase : PhaseMap
        The organising camera's positions along the axis used, with what has been rejected so far.
    correspondence_px : ndarray (H, W, 2) float32 or None
        Pixel (u, v) of the other camera; NaN where the point comes from the projector; None without another camera.
    third : Camera or None
        The projector where it is a check of the points: they do not rest on it, and it does not contradict them all.
    findings : tuple of Finding
        How projector and cameras agree.
    """

    points: TriangulatedPoints
    phase: PhaseMap
    correspondence_px: Map | None = field(metadata={"unit": "px"})
    third: Camera | None
    findings: tuple[Finding, ...] = ()


def cameras_needed(rig: Rig, images: tuple[str, ...], own: str, geometry: Geometry, subject: str) -> tuple[str, ...]:
    """Return the names of the cameras whose images are needed, the organising one first.

    Raises
    ------
    InputError
        Where images or calibration do not suffice.
    """
    other = rig.other(own)
    pair = other is not None and {own, other} <= set(images)
    if own not in images or own not in rig.cameras:
        found = f"images of {', '.join(images)}, calibration of {', '.join(rig.cameras)}"
        raise InputError(subject, found, f"those of camera {own}, which is to organise")
    if geometry != "projector" and pair:
        assert other is not None
        return (own, other)
    if geometry == "stereo" or rig.projector is None:
        projector = "" if rig.projector is None else " and the projector"
        expected = "images and calibration of A and B" + ("" if geometry == "stereo" else ", or of the projector")
        raise InputError(subject, f"one camera ({own}){projector}", expected)
    return (own,)


def locate_between_cameras(
    phases: Mapping[str, Mapping[Axis, PhaseMap]], rig: Rig, own: str, subject: str, threads: int
) -> Located:
    """Return the points that both cameras see; `phases` are theirs, per camera and axis."""
    other = next(name for name in phases if name != own)
    axis = axis_between_cameras(phases[other], rig.cameras[own], rig.cameras[other], subject)
    phase, cameras = phases[own][axis], (rig.cameras[own], rig.cameras[other])
    pairs = correspond(phase, phases[other][axis], *cameras, threads)
    return Located(triangulate(pairs, *cameras, threads), phase, pairs.pixel_px, rig.projector)


def locate_by_correlation(
    seen: Mapping[str, Observation],
    rig: Rig,
    own: str,
    volume: Box | None,
    options: CorrelateOptions,
    subject: str,
    threads: int,
) -> Located:
    """Return the points that both cameras see by statistical patterns, whose place in the projector nobody knows.

    Raises
    ------
    InputError
        Where there are images of one camera only.
    """
    if len(seen) == 1:
        raise InputError(f"{subject}: sequence", "statistical patterns seen by one camera", "images of two cameras")
    other = next(name for name in seen if name != own)
    a, b, cameras = seen[own], seen[other], (rig.cameras[own], rig.cameras[other])
    saturation = (a.view.saturation, b.view.saturation)
    pairs, rejected = correlate(
        a.patterns, b.patterns, *cameras, a.view.noise, b.view.noise, saturation, options, threads, volume
    )
    if a.excluded is not None:
        rejected[a.excluded] = rejection_bit("masked")
    # What is lit has a position; which, nobody knows.
    lit = (rejected & rejection_bit("dark")) == 0
    position = np.where(lit, np.float32(0), np.float32(np.nan))
    phase = PhaseMap("u", position, np.zeros_like(position), rejected)
    return Located(triangulate(pairs, *cameras, threads), phase, pairs.pixel_px, None)


def locate_by_projector(
    phases: Mapping[Axis, PhaseMap], own: Camera, projector: Camera, options: RejectOptions, subject: str, threads: int
) -> Located:
    """Return the points that the organising camera sees and the projector lights; `phases` are its own, per axis."""
    axis = axis_to_projector(phases, own, projector, subject)
    found, phase = intersect(phases, axis, own, projector, threads), phases[axis]
    allowed, findings = _axes_against_each_other(found.miss_px.ravel()[sample_pixels(phase.shape)], options)
    wrong = found.contradiction(allowed, options.sigmas)
    phase = phase.without(wrong, "mismatch")
    for array in (found.points_sensor, found.sigma_mm):
        array[wrong] = np.nan
    # The limit of a miss between cameras knows nothing of noise: what is left here is within it.
    points = replace(found, miss_px=np.full_like(found.miss_px, np.nan))
    return Located(points, phase, None, None, findings)


@dataclass(frozen=True)
class Filling:
    """Points by the projector for pixels that have none by two cameras.

    Parameters
    ----------
    pixels : ndarray (n,) int
        Flat indices of the pixels.
    points_sensor, sigma_mm, miss_px : ndarray (n, 3), (n,), (n,)
        As in TriangulatedPoints.
    trusted : bool
        Whether the projector agrees with the cameras well enough to check their points.
    findings : tuple of Finding
        How projector and cameras agree.
    """

    pixels: NDArray[np.intp]
    points_sensor: Map = field(metadata={"unit": "mm"})
    sigma_mm: Map = field(metadata={"unit": "mm"})
    miss_px: Map = field(metadata={"unit": "px"})
    trusted: bool
    findings: tuple[Finding, ...]


def find_missing(
    located: Located,
    phases: Mapping[Axis, PhaseMap],
    own: Camera,
    projector: Camera,
    period_px: float | None,
    options: RejectOptions,
    subject: str,
    threads: int,
) -> Filling:
    """Return the points that the other camera does not see but the projector's calibration gives.

    Parameters
    ----------
    located : Located
        The points of both cameras.
    phases : dict of PhaseMap
        The organising camera's positions per axis, without errors of their wave form.
    own, projector : Camera
        Their calibration.
    period_px : float or None
        Finest fringe period: the projector may disagree as a function of the phase.
    options : RejectOptions
        Beyond `projector_px` the projector is not used.
    subject : str
        Named in errors.
    threads : int
        Number of threads.

    Notes
    -----
    The systematic disagreement of the two, found from all points that both give, is added to sigma. Where it is larger
    than is allowed, no point rests on the projector, nor does the projector check any.
    """
    try:
        axis = axis_to_projector(phases, own, projector, subject)
    except InputError as error:
        return _nothing(True, (Finding("projector against cameras", None, None, "projector px", error.found),))
    places = sample_pixels(phases[axis].shape)
    sample = intersect(phases, axis, own, projector, threads, places)
    allowed, findings = _axes_against_each_other(sample.miss_px, options)
    sampled = phases[axis].at(places)
    points = located.points.points_sensor.reshape(-1, 3)[places]
    agreement = measure_agreement(points, sample, sampled, own, period_px)
    against = _finding("projector against cameras", agreement, options.projector_px, "points that both cameras see")
    systematic = agreement.systematic_px
    if systematic is None or systematic > options.projector_px:
        return _nothing(systematic is None, (*findings, against))
    missing = np.flatnonzero(np.isnan(located.points.sigma_mm) & np.isfinite(phases[axis].position_px))
    rows = -(-len(missing) // LIST_WIDTH)
    pixels = np.concatenate([missing, np.full(rows * LIST_WIDTH - len(missing), -1)]).reshape(rows, LIST_WIDTH)
    found = intersect(phases, axis, own, projector, threads, pixels)
    with np.errstate(invalid="ignore"):
        per_px = found.sigma_mm / phases[axis].sigma_px.ravel()[pixels]
        sigma = np.hypot(found.sigma_mm, np.float32(systematic) * per_px)
        # Where the projector sees the surface at a grazing angle, its points are worth little.
        good = found.sigma_mm <= options.fill_sigma_ratio * np.nanmedian(located.points.sigma_mm.ravel()[places])
    good &= ~found.contradiction(allowed, options.sigmas)
    pixels, sigma = pixels[good], sigma[good]
    # The limit of a miss between cameras knows nothing of noise: what is left here is within it.
    miss = np.full_like(sigma, np.nan)
    return Filling(pixels, found.points_sensor[good], sigma, miss, True, (*findings, against))


def fill_in(located: Located, filling: Filling) -> Located:
    """Add the points to the maps of `located`, in place."""
    points = located.points
    points.points_sensor.reshape(-1, 3)[filling.pixels] = filling.points_sensor
    points.sigma_mm.reshape(-1)[filling.pixels] = filling.sigma_mm
    points.miss_px.reshape(-1)[filling.pixels] = filling.miss_px
    third = located.third if filling.trusted else None
    return replace(located, third=third, findings=(*located.findings, *filling.findings))


def _nothing(trusted: bool, findings: tuple[Finding, ...]) -> Filling:
    none: Map = np.empty(0, np.float32)
    return Filling(np.empty(0, np.intp), none.reshape(0, 3), none, none, trusted, findings)


def _axes_against_each_other(miss_px: Map, options: RejectOptions) -> tuple[float, tuple[Finding, ...]]:
    """Return the miss [projector px] beyond noise that is allowed to a pixel, and how far both axes disagree."""
    if not np.isfinite(miss_px).any():
        return options.projector_px, ()
    agreement = systematic_miss(miss_px)
    # Where the calibration is off everywhere, a pixel's miss is no reason to reject that pixel.
    allowed = options.projector_px + 2 * (agreement.systematic_px or 0.0)
    finding = _finding("row error against the projector", agreement, options.projector_px, "second axis")
    return allowed, (finding,)


def _finding(quantity: str, agreement: Agreement, limit_px: float, source: str) -> Finding:
    value, unit = agreement.systematic_px, "projector px"
    if value is None:
        return Finding(quantity, None, None, unit, f"too few points: {source}")
    warning = ""
    if value > limit_px:
        warning = (
            f"camera and projector contradict each other by {value:.2f} projector px beyond noise, rms over the image: "
            "calibrate again, or check the projector's size and the sequence's cell_px and period_px"
        )
    return Finding(quantity, value, agreement.sigma_px, unit, source, warning)
