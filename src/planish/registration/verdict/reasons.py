"""The reasons of a verdict: sentences that a metrologist can act on."""

from __future__ import annotations

import numpy as np

from planish.measurement import Measurement
from planish.registration.refine.fit_statistics import FitStatistics
from planish.registration.refine.kept_out import Agreement
from planish.registration.result import Direction, RunnerUp
from planish.registration.texture.periods import Period
from planish.registration.texture.resample import TextureImage
from planish.registration.texture.strength import texture_strength
from planish.registration.verdict.hypothesis import Drift, Hypothesis
from planish.registration.verdict.window_sizes import VerifyOptions, area_mm2, too_small

#: Share of the texture's variance that is signal, above which a window of some 60 independent cells correlates by
#: four standard deviations: 4 / sqrt(60) = 0.5.
_ENOUGH_SIGNAL = 0.5


def why_nothing(images_a: tuple[TextureImage, ...], images_b: tuple[TextureImage, ...], options: VerifyOptions) -> str:
    """Return which it is, no overlap or too little surface or texture, as far as area, texture and noise say."""
    strengths = [texture_strength(images) for images in (images_a, images_b)]
    (a, noise_a), (b, noise_b) = strengths
    if min(a, b) == 0:
        return "one of them shows no surface with texture at all: check exposure and mask"
    smaller = min(images_a, images_b, key=area_mm2)
    if too_small(smaller, options):
        return (
            f"one of them shows only {area_mm2(smaller) / 100:.1f} cm2 of surface, too little for an overlap of 30 % "
            "to be found: check its exposure (pixels too bright or too dark are not measured), mask and volume"
        )
    share = float(np.sqrt(max(0.0, 1 - (noise_a / a) ** 2) * max(0.0, 1 - (noise_b / b) ** 2)))
    figures = f"texture {100 * min(a, b):.2f} %, noise {100 * max(noise_a, noise_b):.2f} %"
    if share >= _ENOUGH_SIGNAL:
        return (
            f"both show texture enough ({figures}) for an overlap of 30 % to be found, so they probably overlap less "
            "or not at all: take a view between them"
        )
    return (
        f"the texture is too weak ({figures}) to tell whether they overlap: take more or brighter images, or move "
        "nearer"
    )


def already_found(a: Measurement, b: Measurement) -> str:
    """Return what measuring warned of, as the end of a refusal: points that contradict themselves fit nowhere."""
    warnings = [f"{m.name}: {finding.warning}" for m in (a, b) for finding in m.findings if finding.warning]
    return f"; but mend first what measuring found in {'; in '.join(warnings)}" if warnings else ""


def repeats_in_itself(period: Period, positions: int) -> str:
    """Return why a pattern leaves the pair ambiguous though no motion stands out."""
    return (
        f"the texture of both repeats every {period.period_mm:.1f} mm, so that some {positions} positions fit alike "
        "and none stands out: add something unique to the overlap (a mark, a rim), or exclude the pattern by a mask or "
        "volume"
    )


def describe_motion(other: RunnerUp) -> str:
    """Return how far another transform is from the chosen one, in words."""
    return f"{other.translation_mm:.1f} mm and {np.rad2deg(other.rotation_rad):.1f} deg"


def repeats(first: Hypothesis, other: RunnerUp, shared: int) -> str:
    """Return why a repeating texture leaves the pair ambiguous."""
    turn = np.rad2deg(other.rotation_rad)
    if turn > 5:
        what = f"turned by {turn:.0f} deg it looks the same"
    else:
        what = f"it repeats after {other.translation_mm:.1f} mm"
    return (
        f"two transforms explain the texture equally well, {describe_motion(other)} apart ({shared} of "
        f"{first.agreeing} agreeing windows fit both): {what}; add something unique to the overlap (a mark, a rim)"
    )


def two_motions(first: Hypothesis, other: Hypothesis, evidence: RunnerUp) -> str:
    """Return why two motions leave the pair ambiguous."""
    return (
        f"two things moved differently, {describe_motion(evidence)} apart: {support(first)} follow one, "
        f"{support(other)} the other; exclude one of them by a mask or volume"
    )


def support(hypothesis: Hypothesis) -> str:
    """Return what agrees with a motion."""
    if hypothesis.agreeing >= 3:
        return f"{hypothesis.agreeing} of {len(hypothesis.windows)} windows"
    return f"{hypothesis.places} places"


def kept_out_elsewhere(kept_out: Agreement) -> str:
    """Return why tiles that took no part in the fit refute it."""
    return (
        f"a fifth of the overlap, kept out of the fit, lies {kept_out.shift_mm:.2f} mm off it (chi-squared "
        f"{kept_out.chi_squared:.0f} of {kept_out.directions} directions): the part moved or bent during the captures, "
        "or the overlap is too small for its texture; capture again, or take a view with more overlap"
    )


def left_consensus(drift: Drift, most_mm: float) -> str:
    """Return why a refinement that left the consensus is not trusted."""
    return (
        f"refinement left the consensus by {drift.mm:.2f} mm ({min(drift.limit_mm, most_mm):.2f} mm allowed): texture "
        "and geometry do not agree, or it ended where the texture looks alike"
    )


def other_texture(fit: FitStatistics) -> str:
    """Return why the textures' differences refute a fit."""
    return (
        f"the refined textures differ by {fit.texture_scale:.1f} times what their noise explains and have "
        f"{100 * max(fit.common_texture, 0):.0f} % of their variance in common: the refinement ended beside the "
        "solution, or the surface was changed between the captures"
    )


def other_surface(fit: FitStatistics) -> str:
    """Return why the surfaces' distances refute a fit."""
    return (
        f"the refined surfaces lie {fit.distance_mm:.2f} mm apart, {fit.distance_scale:.1f} times what their noise "
        "explains: the part moved or bent between or during the captures, or the calibration does not hold"
    )


def loose_directions(directions: list[Direction]) -> str:
    """Return which directions are held by neither geometry nor texture, in words."""
    words = [f"{d.motion} uncertain by {d.sigma_mm:.1f} mm" for d in directions]
    return (
        f"{len(directions)} direction(s) held by neither geometry nor texture: {'; '.join(words)} (axes in the frame "
        "of the first); the texture runs along it (brush marks, lines) or the overlap is too small: take a view with "
        "more overlap, or one that shows an edge"
    )
