"""One pair of measurements: from keypoints to a judged, refined transform with its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.options import thread_count
from planish.registration.consensus import CoarseResult, Search, find_consensus
from planish.registration.dense.match import DenseOptions, match_windows
from planish.registration.match.matching import MatchOptions, match
from planish.registration.match.patches import PatchSide
from planish.registration.matches import Matches
from planish.registration.options import PairOptions
from planish.registration.prepared import Prepared, leave_out
from planish.registration.refine.calibration import ErrorSide, calibration_covariance, calibration_shifts
from planish.registration.refine.covariance import noise_covariance, observability
from planish.registration.refine.fit_statistics import FitStatistics, fit_statistics
from planish.registration.refine.kept_out import Agreement, agreement
from planish.registration.refine.overlap import overlap_axes, overlap_extent, rms_radius
from planish.registration.refine.solve import Refined, refine
from planish.registration.result import Direction, PairResult
from planish.registration.tiles import ground_sample_distance, tile_size_px
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.geometry import line_of_sight
from planish.registration.verdict.hypothesis import Hypothesis
from planish.registration.verdict.judge import Verdict, judge_coarse, judge_refined
from planish.registration.verdict.reasons import already_found


def register_pair(
    a: Prepared, b: Prepared, options: PairOptions | None = None, pairs_in_run: int = 1, threads: int | None = None
) -> PairResult:
    """Return the judged transform of b in a; "cannot be registered" is a result with its reason."""
    result = _tried(a, b, options or PairOptions(), pairs_in_run, threads)
    if result.status != "refused":
        return result
    return replace(result, reason=result.reason + already_found(a.measurement, b.measurement))


def _tried(a: Prepared, b: Prepared, options: PairOptions, pairs_in_run: int, threads: int | None) -> PairResult:
    """Return the result by keypoints or, where these fail, by whole textures."""
    matches = match(_patch_side(a), _patch_side(b), options.match, threads)
    coarse = find_consensus(matches, options.consensus, threads, search=_patch_search(a, options.match))
    result = _judged(a, b, matches, coarse, options, pairs_in_run, threads)
    if result.status != "refused" or not (options.dense.enabled and keypoints_may_fail(a, b, options.dense)):
        return result
    windows = match_windows(a.dense, b.dense, options.consensus.tolerance_mm, options.dense, threads)
    search = Search(np.inf, windows.chance, windows.tried)
    coarse = find_consensus(windows.matches, options.consensus, threads, search=search)
    # A pair that is tried twice has twice the chance of a false alarm.
    second = _judged(a, b, windows.matches, coarse, options, _TRIES * pairs_in_run, threads)
    first = _tried_again(result)
    # Of two refusals the one that says more.
    better = second.log10_false_alarms < first.log10_false_alarms
    return second if second.status != "refused" or better else first


#: By its keypoints, and by whole textures where these fail.
_TRIES = 2


def _tried_again(result: PairResult) -> PairResult:
    """Return a refusal by keypoints with the false alarms of both tries."""
    more = float(np.log10(_TRIES))
    other = result.runner_up
    return replace(
        result,
        reason=result.reason + "; correlating the whole textures, which counts as a second try, said no more",
        log10_false_alarms=result.log10_false_alarms + more,
        runner_up=other and replace(other, log10_false_alarms=other.log10_false_alarms + more),
    )


def _judged(
    a: Prepared,
    b: Prepared,
    matches: Matches,
    coarse: CoarseResult,
    options: PairOptions,
    pairs_in_run: int,
    threads: int | None,
) -> PairResult:
    """Return the result that these matches and their consensus lead to."""
    side_a, side_b = (Side(p.measurement, p.images, p.contrast, threads) for p in (a, b))
    verdict = judge_coarse(side_a, side_b, matches, coarse, pairs_in_run, options.verdict, threads)
    first = verdict.first
    result = PairResult(
        a=a.measurement.name,
        b=b.measurement.name,
        status=verdict.judgement.status,
        reason=verdict.judgement.reason,
        matches=len(matches),
        consensus=first.places if first else 0,
        log10_false_alarms=verdict.log10_false_alarms,
        windows=len(first.windows) if first else 0,
        windows_agreeing=first.agreeing if first else 0,
        runner_up=verdict.runner_up,
        motions=verdict.motions,
        T_coarse_a_b=first.T_a_b if first else None,
        matches_px=_pixels(matches),
        consensus_px=_pixels(matches.take(first.members)) if first else np.empty((0, 4)),
    )
    if first is None or result.status != "accepted":
        return result
    return _refined_result(a, b, verdict, first, result, options, threads)


def _patch_search(side: Prepared, options: MatchOptions) -> Search:
    """How keypoints are matched: by the patches around them."""
    radius_px = options.patch_radius_px + options.reach_px
    return Search(radius_px * side.images[0].pitch_mm) if side.images else Search()


def _patch_side(side: Prepared) -> PatchSide:
    return PatchSide(side.keypoints, side.images, side.patches)


def keypoints_may_fail(a: Prepared, b: Prepared, options: DenseOptions) -> bool:
    """Whether a pair may share texture that keypoints do not tell apart: weak, or not strong and running one way."""
    if is_weak(a, b, options):
        return True
    if min(a.signal_to_noise, b.signal_to_noise) >= options.max_directed_signal_to_noise:
        return False
    return all(any(texture.spectrum.directional for texture in side.dense) for side in (a, b))


def is_weak(a: Prepared, b: Prepared, options: DenseOptions) -> bool:
    """Whether single pixels hold too little texture: keypoints may fail, and slopes are mostly noise."""
    return min(a.signal_to_noise, b.signal_to_noise) < options.max_signal_to_noise


def _refined_result(
    a: Prepared,
    b: Prepared,
    verdict: Verdict,
    first: Hypothesis,
    result: PairResult,
    options: PairOptions,
    threads: int | None,
) -> PairResult:
    # What agrees with a consensus does so within this.
    within_mm = options.verdict.verify.agree_mm
    refined = refine_pair(a, b, first.T_a_b, options, threads, verdict.without, within_mm)
    covariance = noise_covariance(refined) if refined is not None else None
    directions: tuple[Direction, ...] = ()
    kept_out, fit = None, None
    if refined is not None and covariance is not None:
        fit = residual_statistics(a, b, refined, options, threads, verdict.without)
        kept_out = kept_out_agreement(a, b, refined, covariance, options, threads, verdict.without)
        covariance = covariance * kept_out.factor
        directions = observability(refined, covariance, overlap_axes(a.measurement, b.measurement, refined.T_a_b))
    T, gate = first.T_a_b if refined is None else refined.T_a_b, options.verdict.verify.gate_mm
    sight = line_of_sight(a.measurement, b.measurement, T, gate, verdict.without)
    drift = first.drift(T, a.images[0].pitch_mm)
    unmoved_mm = options.verdict.still_px * ground_sample_distance(a.measurement) if verdict.unmoved else None
    refuted = judge_refined(refined, directions, drift, sight, options.verdict, unmoved_mm, kept_out, fit)
    if refined is None or kept_out is None or refuted is not None:
        assert refuted is not None
        return replace(result, status=refuted.status, reason=refuted.reason, observability=directions)
    shifts = pair_shifts(a, b, refined, options, threads)
    return replace(
        result,
        T_a_b=refined.T_a_b,
        covariance_noise=covariance,
        covariance_factor=kept_out.factor,
        covariance_calibration=calibration_covariance(shifts),
        calibration_shifts=shifts,
        covariance_point_mm=refined.about,
        observability=directions,
        used=True,
    )


def refine_pair(
    a: Prepared,
    b: Prepared,
    T_a_b: Array,
    options: PairOptions | None = None,
    threads: int | None = None,
    without: tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None] = (None, None),
    within_mm: float = np.inf,
) -> Refined | None:
    """Return the joint refinement of a pair from a coarse transform, or None where the surfaces do not overlap.

    `without` (H, W) of a and of b are pixels that take no part. The start is not farther off than `within_mm`.
    """
    options = options or PairOptions()
    steps = options.refine.starting_within(within_mm, ground_sample_distance(b.measurement))
    farthest = max(*options.refine.max_distance_mm, steps.first_gate_mm(rms_radius(b.measurement)))
    extent = overlap_extent(a.measurement, b.measurement, T_a_b, farthest)
    if extent is None:
        return None
    centre, radius = extent
    # Pairs that are tried side by side share measurements: of two, the one that no other pair is at comes first.
    for side in (a, b):
        side.refinement.begin()
    tile = tile_size_px(b.measurement)
    sides_a, sides_b = leave_out(a.fit_sides, without[0]), leave_out(b.sides, without[1])
    return refine(sides_a, sides_b, T_a_b, centre, radius, tile, steps, threads)


def kept_out_agreement(
    a: Prepared,
    b: Prepared,
    refined: Refined,
    covariance: Array,
    options: PairOptions | None = None,
    threads: int | None = None,
    without: tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None] = (None, None),
) -> Agreement:
    """Return what the tiles of a that took no part in a fit say about it; arguments as in `refine_pair`."""
    options = options or PairOptions()
    finest = options.refine.spacing_px[-1]
    every, fitted = a.sides[finest], a.fit_sides[finest]
    only = leave_out({finest: replace(every, use=every.use - fitted.use)}, without[0])
    side_b = leave_out({finest: b.sides[finest]}, without[1])[finest]
    tile = tile_size_px(b.measurement)
    return agreement(only[finest], side_b, refined, covariance, tile, options.refine, thread_count(threads))


def residual_statistics(
    a: Prepared,
    b: Prepared,
    refined: Refined,
    options: PairOptions | None = None,
    threads: int | None = None,
    without: tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None] = (None, None),
) -> FitStatistics:
    """Return what the size of all residuals says about a fit; arguments as in `refine_pair`."""
    options = options or PairOptions()
    finest = options.refine.spacing_px[-1]
    side_a, side_b = (
        leave_out({finest: p.sides[finest]}, mask)[finest] for p, mask in zip((a, b), without, strict=True)
    )
    shading_px = options.photometric.shading_mm / ground_sample_distance(b.measurement)
    return fit_statistics(side_a, side_b, refined, options.refine, thread_count(threads), shading_px)


def pair_shifts(
    a: Prepared, b: Prepared, refined: Refined, options: PairOptions | None = None, threads: int | None = None
) -> dict[str, Array] | None:
    """Return per rig what its errors do to a refined transform, or None where a rig states none."""
    options = options or PairOptions()
    finest = options.refine.spacing_px[-1]
    sides = ErrorSide(a.measurement, a.fit_sides[finest]), ErrorSide(b.measurement, b.sides[finest])
    return calibration_shifts(*sides, refined, options.refine, threads)


def _pixels(matches: Matches) -> Array:
    return np.hstack([matches.pixels_a, matches.pixels_b])
