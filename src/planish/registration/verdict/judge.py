"""Accepted, refused or ambiguous, with a reason a metrologist can act on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.geometry import Array
from planish.options import Options
from planish.registration.consensus import CoarseResult, find_consensus
from planish.registration.matches import Matches
from planish.registration.refine.fit_statistics import FitStatistics
from planish.registration.refine.kept_out import Agreement
from planish.registration.refine.solve import Refined
from planish.registration.result import Direction, Motion, RunnerUp, Status
from planish.registration.tiles import ground_sample_distance
from planish.registration.verdict import reasons, still
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.geometry import Sight, line_of_sight
from planish.registration.verdict.hypothesis import Drift, Hypothesis, apart, as_hypothesis, weigh
from planish.registration.verdict.lattice import as_good_a_period_off, common_period, positions
from planish.registration.verdict.repeats import rival_transforms
from planish.registration.verdict.rivals import Rivalry, alike, compare
from planish.registration.verdict.window_sizes import VerifyOptions, area_mm2, for_areas


class VerdictOptions(Options):
    """Limits of the verdict."""

    verify: VerifyOptions = VerifyOptions()
    #: Accept only if fewer false alarms than 10^this are to be expected in the whole run.
    max_log10_false_alarms: float = Field(default=-3.0, le=0)
    #: Of two significant consensuses that the windows cannot tell apart, the second makes the pair ambiguous if it has
    #: at least this share of the places.
    ambiguous_share: float = Field(default=0.3, gt=0, le=1)
    #: What moved less than this between two captures of one sensor stands still [px].
    still_px: float = Field(default=2.0, gt=0)
    #: Surfaces that contradict each other (hide or pierce one another) over more than this share refute the transform.
    max_conflict_share: float = Field(default=0.3, gt=0, lt=1)
    #: The refined transform may leave the consensus by this much (rms over its members) [mm].
    max_drift_mm: float = Field(default=1.5, gt=0)
    #: Surfaces that lie apart by more than this, beyond what noise explains, are not the same [mm]: a pixel of the
    #: reference sensor, more than a usable calibration bends a surface by.
    max_residual_mm: float = Field(default=0.33, gt=0)
    #: Significance of the correlation between the aligned textures, in standard deviations.
    min_correlation_sigma: float = Field(default=5.0, gt=0)


@dataclass(frozen=True)
class Judgement:
    """A status with its reason."""

    status: Status
    reason: str


@dataclass(frozen=True)
class Verdict:
    """What the evidence before the refinement says of a pair.

    Parameters
    ----------
    judgement : Judgement
    first : Hypothesis or None
        The motion judged; its transform is the start of the refinement.
    log10_false_alarms : float
        Of the first, in the whole run.
    runner_up : RunnerUp or None
    motions : tuple of Motion
        All, where several things moved differently; else empty.
    without : tuple of two ndarray (H, W) or None
        Pixels of a and b that stood still while the part moved: they take no part in the refinement.
    unmoved : bool
        Whether all that agrees stands still: accepted only if the surfaces alone prove it.
    """

    judgement: Judgement
    first: Hypothesis | None
    log10_false_alarms: float
    runner_up: RunnerUp | None = None
    motions: tuple[Motion, ...] = ()
    without: tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None] = (None, None)
    unmoved: bool = False


def judge_coarse(
    a: Side,
    b: Side,
    matches: Matches,
    coarse: CoarseResult,
    pairs_in_run: int,
    options: VerdictOptions | None = None,
    threads: int | None = None,
) -> Verdict:
    """Judge the candidates of the consensus, before the refinement.

    Parameters
    ----------
    a, b : Side
    matches : Matches
    coarse : CoarseResult
        Of these matches.
    pairs_in_run : int
        Pairs of measurements tried in the run.
    options : VerdictOptions, optional
    threads : int, optional
    """
    options = options or VerdictOptions()
    fitting = options.model_copy(update={"verify": for_areas(a.images, b.images, options.verify)})
    case = _Case(a, b, matches, pairs_in_run, fitting, threads)
    found = case.hypotheses(coarse)
    if not found:
        return Verdict(_no_consensus(case, coarse), None, np.log10(pairs_in_run) + np.log10(max(coarse.places, 2) ** 2))
    best = found[0]
    significant = [h for h in found if case.alarms(h) <= options.max_log10_false_alarms]
    if not significant:
        return Verdict(_not_significant(case, best, coarse), best, case.alarms(best), case.runner_up(best, found[1:]))
    unmoving = [h for h in significant if case.stands_still(h)]
    moving = [h for h in significant if not case.stands_still(h)]
    if not moving:
        nothing_moved = f"nothing moved: {reasons.support(best)} agree at the same pixels"
        judgement = _repeats(case) or Judgement("accepted", nothing_moved)
        return Verdict(judgement, unmoving[0], case.alarms(unmoving[0]), unmoved=True)
    return _judge_moving(case, moving, unmoving)


@dataclass(frozen=True)
class _Case:
    """One pair on trial."""

    a: Side
    b: Side
    matches: Matches
    pairs_in_run: int
    options: VerdictOptions
    threads: int | None

    def alarms(self, h: Hypothesis) -> float:
        """log10 of the false alarms in the whole run."""
        return h.log10_false_alarms + float(np.log10(max(self.pairs_in_run, 1)))

    def stands_still(self, h: Hypothesis) -> bool:
        same = still.same_sensor(self.a.measurement, self.b.measurement)
        return same and h.moved_px < self.options.still_px

    def hypotheses(self, coarse: CoarseResult) -> list[Hypothesis]:
        """All different motions, the most certain first.

        Where one stands still in the image (sensor pattern, background), the part's own motion may hide behind it: what
        moves is asked alone, too.
        """
        found = self._weighed(coarse, [])
        if any(self.stands_still(h) for h in found) and all(
            self.stands_still(h) or self.alarms(h) > self.options.max_log10_false_alarms for h in found
        ):
            rest = still.standing_still(self.matches, self.options.still_px)
            moving = find_consensus(self.matches, coarse.options, self.threads, rest, coarse.search)
            found = self._weighed(moving, found)
        return sorted(found, key=lambda h: h.log10_false_alarms)

    def _weighed(self, coarse: CoarseResult, found: list[Hypothesis]) -> list[Hypothesis]:
        for candidate in coarse.candidates:
            h = weigh(self.a, self.b, self.matches, candidate, coarse, self.options.verify)
            if not any(self.same(h, other) for other in found):
                found = [*found, h]
        return found

    def same(self, h: Hypothesis, other: Hypothesis) -> bool:
        return alike(h, other, self.matches.points_b, 3 * self.options.verify.agree_mm)

    def runner_up(self, first: Hypothesis, others: list[Hypothesis]) -> RunnerUp | None:
        if not others:
            return None
        other = others[0]
        rotation, shift = apart(first, other, self.matches.points_b.mean(0))
        return RunnerUp(other.places, self.alarms(other), other.T_a_b, rotation, shift)

    def motion(self, h: Hypothesis) -> Motion:
        chosen = h.windows.credible & np.isfinite(h.windows.found_b).all(1)
        pixels_a, pixels_b = h.windows.pixels_a[chosen], h.windows.found_b[chosen]
        if len(pixels_a) == 0:
            members = self.matches.take(h.members)
            pixels_a, pixels_b = members.pixels_a, members.pixels_b
        return Motion(
            h.T_a_b, h.places, h.agreeing, self.alarms(h), self.stands_still(h), _box(pixels_a), _box(pixels_b)
        )


def _box(pixels: Array) -> tuple[float, float, float, float]:
    # The middle 90 %: single windows agree by chance, wherever they lie.
    low, high = np.percentile(pixels, [5, 95], axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _repeats(case: _Case) -> Judgement | None:
    """Return that no motion can stand out, where both textures repeat in themselves; else None."""
    period = common_period(case.a.images, case.b.images)
    if period is None:
        return None
    smaller = min(case.a.images, case.b.images, key=area_mm2)
    return Judgement("ambiguous", reasons.repeats_in_itself(period, positions(period, smaller)))


def _no_consensus(case: _Case, coarse: CoarseResult) -> Judgement:
    return _repeats(case) or Judgement(
        "refused",
        f"no consensus: no three of {coarse.places} matched places agree on a transform; "
        + reasons.why_nothing(case.a.images, case.b.images, case.options.verify),
    )


def _not_significant(case: _Case, best: Hypothesis, coarse: CoarseResult) -> Judgement:
    return _repeats(case) or Judgement(
        "refused",
        f"consensus not significant: {best.places} of {coarse.places} matched places and {best.agreeing} of "
        f"{len(best.windows)} windows agree, which chance explains (10^{case.alarms(best):.1f} expected in this run, "
        f"at most 10^{case.options.max_log10_false_alarms:.0f} allowed); "
        + reasons.why_nothing(case.a.images, case.b.images, case.options.verify),
    )


def _judge_moving(case: _Case, moving: list[Hypothesis], unmoving: list[Hypothesis]) -> Verdict:
    """Judge what moves: rivals, then geometry; what stands still beside it is named and left out."""
    options = case.options
    first, rival, rivalry = _rival(case, moving)
    others = [rival] if rival else [*moving[1:], *unmoving]
    verdict = Verdict(
        Judgement("accepted", _accepted(case, first)), first, case.alarms(first), case.runner_up(first, others)
    )
    if rival is not None and rivalry is not None and verdict.runner_up is not None:
        if rivalry.relation == "repeats":
            reason = reasons.repeats(first, verdict.runner_up, rivalry.shared)
            return replace(verdict, judgement=Judgement("ambiguous", reason))
        if (repeated := _repeats(case)) is not None:
            # Places of a pattern that each of the two explains, and no motions of their own.
            return replace(verdict, judgement=repeated)
        reason = reasons.two_motions(first, rival, verdict.runner_up)
        motions = tuple(case.motion(h) for h in (first, rival, *unmoving))
        return replace(verdict, judgement=Judgement("ambiguous", reason), motions=motions)
    by_period = as_good_a_period_off(case.a, case.b, first, options.verify, options.ambiguous_share)
    if by_period is not None and (repeated := _repeats(case)) is not None:
        return replace(verdict, judgement=repeated, runner_up=case.runner_up(first, [by_period]))
    if unmoving:
        verdict = _beside_what_stands_still(case, verdict, first, unmoving[0])
    sight = line_of_sight(case.a.measurement, case.b.measurement, first.T_a_b, options.verify.gate_mm, verdict.without)
    if sight.conflict > options.max_conflict_share:
        return replace(verdict, judgement=_contradiction(sight, first))
    return verdict


def _accepted(case: _Case, first: Hypothesis) -> str:
    return (
        f"{first.places} matched places and {first.agreeing} of {len(first.windows)} windows of the predicted overlap "
        f"agree (10^{case.alarms(first):.0f} by chance)"
    )


def _beside_what_stands_still(case: _Case, verdict: Verdict, first: Hypothesis, unmoved: Hypothesis) -> Verdict:
    shapes = (case.a.measurement.shape, case.b.measurement.shape)
    half_px = case.options.verify.window_mm / 2 / ground_sample_distance(case.a.measurement)
    note = (
        f"; {reasons.support(unmoved)} stood still in the image (background, or the sensor's own pattern) and "
        "were left out"
    )
    return replace(
        verdict,
        judgement=Judgement(verdict.judgement.status, verdict.judgement.reason + note),
        motions=(case.motion(first), case.motion(unmoved)),
        without=still.left_out(unmoved, first, shapes, half_px),
    )


def _rival(case: _Case, moving: list[Hypothesis]) -> tuple[Hypothesis, Hypothesis | None, Rivalry | None]:
    """Return the best motion, and the rival that leaves it ambiguous with the relation of both, if there is one."""
    options = case.options
    first = moving[0]
    apart_mm = 3 * options.verify.agree_mm
    suggested = [
        as_hypothesis(case.a, case.b, T, options.verify)
        for T in rival_transforms(first.windows.charts, first.T_a_b, apart_mm, options.verify.gate_mm, case.threads)
    ]
    equal: list[tuple[Hypothesis, Rivalry]] = []
    for other in [*moving[1:], *suggested]:
        if case.same(first, other):
            continue
        rivalry = compare(first, other, options.max_log10_false_alarms)
        if rivalry.relation == "weak":
            # Sparse marks fill few windows: there the places of the consensuses decide.
            if other.places >= options.ambiguous_share * first.places:
                return first, other, Rivalry("two motions", 0, other.agreeing, 0.0)
            continue
        if rivalry.relation == "other":
            first, equal = other, []
        elif rivalry.relation == "two motions":
            return first, other, rivalry
        elif rivalry.relation == "repeats":
            equal.append((other, rivalry))
    if not equal:
        return first, None, None
    # Of a lattice of repetitions the nearest tells the period.
    return first, *min(equal, key=lambda item: _distance(case, first, item[0]))


def _distance(case: _Case, first: Hypothesis, other: Hypothesis) -> float:
    """How far apart two motions are, a turn counted at the rim of b [mm]."""
    points = case.matches.points_b
    rotation, shift = apart(first, other, points.mean(0))
    return shift + rotation * float(np.linalg.norm(np.ptp(points, axis=0))) / 2


def _contradiction(sight: Sight, first: Hypothesis) -> Judgement:
    return Judgement(
        "refused",
        f"geometry contradicts the texture: over {100 * sight.conflict:.0f} % of the overlap that "
        f"{reasons.support(first)} suggest, the surfaces pierce or hide one another: check that both captures show the "
        "same part in the same state, and the calibration",
    )


def judge_refined(
    refined: Refined | None,
    directions: tuple[Direction, ...],
    drift: Drift,
    sight: Sight,
    options: VerdictOptions,
    unmoved_mm: float | None = None,
    kept_out: Agreement | None = None,
    fit: FitStatistics | None = None,
) -> Judgement | None:
    """Return why the refinement refutes the consensus, or None where it confirms it.

    `sight` is what the cameras say about the surfaces under the refined transform.
    `unmoved_mm` is given where all that agrees stands still in the image: by how much the part may have moved unseen.
    `kept_out` is what the tiles say that took no part in the fit, `fit` what the size of the residuals says.
    """
    if refined is None:
        return Judgement("refused", "the surfaces do not overlap under the transform that the texture suggests")
    if unmoved_mm is not None and not still.geometry_stands_still(refined, unmoved_mm):
        return Judgement(
            "refused",
            "the agreeing texture stands still in the image: it belongs to the sensor (pixel response, dust), to a "
            "background that does not move with the part, or the part was not moved between the captures; its surface "
            "alone does not tell which (a plane slides unseen): move the part or the sensor by more than a few pixels",
        )
    if sight.conflict > options.max_conflict_share:
        return Judgement(
            "refused",
            f"geometry contradicts the texture: over {100 * sight.conflict:.0f} % of the overlap the surfaces hide one "
            "another from the cameras",
        )
    if drift.mm > min(drift.limit_mm, options.max_drift_mm):
        return Judgement("refused", reasons.left_consensus(drift, options.max_drift_mm))
    if fit is not None and (against := _residuals_against(fit, refined, options)) is not None:
        return against
    if kept_out is not None and kept_out.contradicts and kept_out.shift_mm > options.max_drift_mm:
        return Judgement("refused", reasons.kept_out_elsewhere(kept_out))
    loose = [d for d in directions if not d.observable]
    return Judgement("refused", reasons.loose_directions(loose)) if loose else None


#: Textures that have less than this share in common are unrelated rather than the same.
_HALF = 0.5
#: One-sided, by chance once in a million.
_SURELY = 5.0


def _residuals_against(fit: FitStatistics, refined: Refined, options: VerdictOptions) -> Judgement | None:
    """Return why the size of the residuals refutes a fit, or None."""
    if fit.correlation_sigma < options.min_correlation_sigma:
        return Judgement(
            "refused",
            f"the textures do not correlate where they should overlap (r = {refined.equations.correlation:.3f}, "
            f"{fit.correlation_sigma:.1f} sigma)",
        )
    if fit.most_common_texture + _SURELY * fit.sigma < _HALF:
        return Judgement("refused", reasons.other_texture(fit))
    if fit.distance_mm > options.max_residual_mm:
        return Judgement("refused", reasons.other_surface(fit))
    return None
