"""Accepted, refused or ambiguous, with a reason a metrologist can act on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from planish.geometry import Array, rotation_angle, transform_points
from planish.options import Options
from planish.registration.consensus import Candidate, CoarseResult
from planish.registration.refine.solve import Refined
from planish.registration.result import Direction, RunnerUp, Status
from planish.registration.verdict.false_alarms import log10_false_alarms


class VerdictOptions(Options):
    """Limits of the verdict."""

    #: Accept only if fewer false consensuses than 10^this are to be expected in the whole run.
    max_log10_false_alarms: float = Field(default=-3.0, le=0)
    #: A significant second transform with at least this share of the places makes the pair ambiguous.
    ambiguous_share: float = Field(default=0.3, gt=0, le=1)
    #: A match whose pixel moved less than this between two captures of one sensor stands still [px].
    still_px: float = Field(default=2.0, gt=0)
    #: A consensus of which more than this share stands still is refuted.
    still_share: float = Field(default=0.5, gt=0, lt=1)
    #: Surfaces that contradict each other (hide or pierce one another) over more than this share refute the transform.
    max_conflict_share: float = Field(default=0.3, gt=0, lt=1)
    #: The refined transform may leave the consensus by this much (rms over its members) [mm].
    max_drift_mm: float = Field(default=1.5, gt=0)
    #: Significance of the correlation between the aligned textures, in standard deviations.
    min_correlation_sigma: float = Field(default=5.0, gt=0)


@dataclass(frozen=True)
class Judgement:
    """A status with its reason."""

    status: Status
    reason: str


def runner_up(coarse: CoarseResult, centre_b: Array, pairs_in_run: float) -> RunnerUp | None:
    """Return the second candidate as evidence, with its difference from the first at a point of b."""
    if len(coarse.candidates) < 2:
        return None
    first, second = coarse.candidates[:2]
    shift = transform_points(second.T_a_b, centre_b) - transform_points(first.T_a_b, centre_b)
    return RunnerUp(
        second.places,
        log10_false_alarms(second.places, coarse.places, coarse.chance, pairs_in_run),
        second.T_a_b,
        rotation_angle(first.T_a_b[:3, :3].T @ second.T_a_b[:3, :3]),
        float(np.linalg.norm(shift)),
    )


def judge_coarse(
    coarse: CoarseResult, other: RunnerUp | None, still_share: float, pairs_in_run: float, options: VerdictOptions
) -> Judgement:
    """Judge the consensus alone, before the refinement."""
    best: Candidate | None = coarse.candidates[0] if coarse.candidates else None
    if best is None or best.places < 3:
        return Judgement(
            "refused",
            f"no consensus: no three of {coarse.places} matched places agree on a transform; the measurements do not "
            "overlap, or the overlap holds too little texture",
        )
    alarms = log10_false_alarms(best.places, coarse.places, coarse.chance, pairs_in_run)
    if alarms > options.max_log10_false_alarms:
        return Judgement(
            "refused",
            f"consensus not significant: {best.places} of {coarse.places} matched places agree, which chance explains "
            f"(10^{alarms:.1f} expected in this run, at most 10^{options.max_log10_false_alarms:.0f} allowed); the "
            "measurements do not overlap, or the overlap holds too little texture",
        )
    if still_share > options.still_share:
        return Judgement(
            "refused",
            f"the agreeing texture stands still in the image ({100 * still_share:.0f} % of the consensus moved less "
            f"than {options.still_px:g} px): it belongs to the sensor (pixel response, dust) or to a background that "
            "does not move with the part",
        )
    significant = other is not None and other.log10_false_alarms <= options.max_log10_false_alarms
    if other is not None and significant and other.consensus >= options.ambiguous_share * best.places:
        return Judgement(
            "ambiguous",
            f"two transforms explain the texture: {best.places} and {other.consensus} places, "
            f"{other.translation_mm:.1f} mm and {np.rad2deg(other.rotation_rad):.1f} deg apart; the texture repeats, "
            "or two things moved differently (exclude one by a mask or volume)",
        )
    return Judgement("accepted", f"{best.places} of {coarse.places} matched places agree (10^{alarms:.0f} by chance)")


def judge_refined(
    refined: Refined | None,
    directions: tuple[Direction, ...],
    drift_mm: float,
    options: VerdictOptions,
) -> Judgement | None:
    """Return why the refinement refutes the consensus, or None where it confirms it."""
    if refined is None:
        return Judgement("refused", "the surfaces do not overlap under the transform that the texture suggests")
    e = refined.equations
    conflict = e.conflicts / max(1, e.conflicts + e.points)
    if conflict > options.max_conflict_share:
        return Judgement(
            "refused",
            f"geometry contradicts the texture: over {100 * conflict:.0f} % of the overlap the surfaces pierce or hide "
            "one another",
        )
    if drift_mm > options.max_drift_mm:
        return Judgement(
            "refused", f"refinement left the consensus by {drift_mm:.2f} mm: texture and geometry do not agree"
        )
    significance = e.correlation * np.sqrt(e.texture_points / _INDEPENDENT_PX)
    if significance < options.min_correlation_sigma:
        return Judgement(
            "refused",
            f"the textures do not correlate where they should overlap (r = {e.correlation:.3f}, "
            f"{significance:.1f} sigma)",
        )
    loose = [d for d in directions if not d.observable]
    if loose:
        return Judgement(
            "refused",
            f"{len(loose)} direction(s) held by neither geometry nor texture, the worst uncertain by "
            f"{max(d.sigma_mm for d in loose):.1f} mm",
        )
    return None


#: Pixels per independent value of the smoothed textures (4 pi s^2 for a Gaussian of s = 1.5 px, rounded up).
_INDEPENDENT_PX = 30.0
