"""One pair of measurements: from keypoints to a judged, refined transform with its covariance."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.options import Options, thread_count
from planish.registration.consensus import CoarseResult, ConsensusOptions, Search, find_consensus
from planish.registration.dense.match import DenseOptions, DenseTexture, match_windows, prepare_dense
from planish.registration.keypoints.detect import KeypointOptions, detect_keypoints
from planish.registration.keypoints.keypoints import Keypoints
from planish.registration.match.matching import MatchOptions, match
from planish.registration.match.patches import PatchSide
from planish.registration.match.whitening import PatchImage, patch_images
from planish.registration.matches import Matches
from planish.registration.refine.anchor import Anchor
from planish.registration.refine.calibration import ErrorSide, calibration_covariance, calibration_shifts
from planish.registration.refine.covariance import noise_covariance, observability
from planish.registration.refine.fit_statistics import FitStatistics, fit_statistics
from planish.registration.refine.kept_out import Agreement, agreement
from planish.registration.refine.overlap import overlap_axes, overlap_extent
from planish.registration.refine.sides import JointSide, held_out_pixels, joint_sides
from planish.registration.refine.solve import Refined, RefineOptions, refine
from planish.registration.result import Direction, PairResult
from planish.registration.surface import Surface, SurfaceOptions, fit_surface
from planish.registration.texture.camera_pattern import FixedPattern
from planish.registration.texture.charts import ChartOptions
from planish.registration.texture.photometric import PhotometricOptions, local_contrast
from planish.registration.texture.resample import TextureImage, texture_images
from planish.registration.texture.strength import signal_to_noise
from planish.registration.tiles import ground_sample_distance, tile_size_px
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.geometry import line_of_sight
from planish.registration.verdict.hypothesis import Hypothesis
from planish.registration.verdict.judge import Verdict, VerdictOptions, judge_coarse, judge_refined


class PairOptions(Options):
    """Options of all stages of a pair."""

    surface: SurfaceOptions = SurfaceOptions()
    photometric: PhotometricOptions = PhotometricOptions()
    charts: ChartOptions = ChartOptions()
    keypoints: KeypointOptions = KeypointOptions()
    match: MatchOptions = MatchOptions()
    dense: DenseOptions = DenseOptions()
    consensus: ConsensusOptions = ConsensusOptions()
    refine: RefineOptions = RefineOptions()
    verdict: VerdictOptions = VerdictOptions()


#: Per spacing of the pixels.
Sides = Mapping[int, JointSide]


class RefinementMaps:
    """What the refinement needs of one measurement: made when the first pair is accepted, for most are refused.

    `make` returns per spacing the maps, and those without the tiles that later judge the fit. Each measurement has a
    lock of its own: those of others are made at the same time.
    """

    def __init__(self, make: Callable[[], tuple[Sides, Sides]]) -> None:
        self._make, self._lock = make, threading.Lock()
        self._made: tuple[Sides, Sides] | None = None

    def get(self) -> tuple[Sides, Sides]:
        """Return what `make` has made, made once."""
        with self._lock:
            if self._made is None:
                self._made = self._make()
            return self._made


@dataclass(frozen=True)
class Prepared:
    """What registration needs of one measurement, computed once and used in every pair."""

    measurement: Measurement
    surface: Surface
    contrast: tuple[Map, Map]
    images: tuple[TextureImage, ...]
    patches: tuple[PatchImage, ...]
    keypoints: Keypoints
    refinement: RefinementMaps
    dense_options: DenseOptions

    @property
    def sides(self) -> Sides:
        """Per spacing of the pixels what the refinement needs."""
        return self.refinement.get()[0]

    @property
    def fit_sides(self) -> Sides:
        """The same without the tiles that later judge the fit."""
        return self.refinement.get()[1]

    @cached_property
    def dense(self) -> tuple[DenseTexture, ...]:
        """The developed texture: made when the first pair asks for it."""
        return prepare_dense(self.images, self.dense_options)

    @cached_property
    def signal_to_noise(self) -> float:
        """How strong the texture is against its noise (variances)."""
        return signal_to_noise(self.images)


#: Pitch of the texture images in multiples of the ground sample distance: the detector doubles the image, so that its
#: finest scale is near the camera's own resolution.
_PITCH_GSD = 1.5
#: Ground sample distance that the default lengths of the options are made for [mm per pixel].
REFERENCE_GSD_MM = 0.33


def median_gsd(gsds_mm: Iterable[float]) -> float:
    """Return the ground sample distance of a run [mm per pixel] from those of its measurements (NaN where unknown)."""
    known = [g for g in gsds_mm if np.isfinite(g)]
    return float(np.median(known)) if known else REFERENCE_GSD_MM


def common_gsd(measurements: Sequence[Measurement]) -> float:
    """Return the median ground sample distance of a run [mm per pixel], so that keypoints of all compare."""
    return median_gsd(map(ground_sample_distance, measurements))


def texture_pitch(gsd_mm: float) -> float:
    """Return the pitch of the texture images [mm] of a run of this ground sample distance [mm per pixel]."""
    return _PITCH_GSD * gsd_mm


def common_pitch(measurements: Sequence[Measurement]) -> float:
    """Return the pitch of the texture images of a run [mm]."""
    return texture_pitch(common_gsd(measurements))


def length_factor(gsd_mm: float) -> float:
    """Return by how much lengths of the options grow for a ground sample distance, in steps of a quarter octave.

    Steps, so that one more measurement does not change every option a little.
    """
    return float(2.0 ** (round(4 * np.log2(gsd_mm / REFERENCE_GSD_MM)) / 4))


@dataclass(frozen=True)
class Textured:
    """A measurement with its surface, its local contrast (value, sigma) and its texture images."""

    measurement: Measurement
    surface: Surface
    contrast: tuple[Map, Map]
    images: tuple[TextureImage, ...]


def draw_texture(
    measurement: Measurement,
    pitch_mm: float,
    options: PairOptions | None = None,
    threads: int | None = None,
    fixed: FixedPattern | None = None,
) -> Textured:
    """Return surface and texture images of one measurement: all that its keypoints need.

    `fixed` is the pattern of its sensor (`estimate_fixed_patterns`), which is no texture.
    """
    options = options or PairOptions()
    surface = fit_surface(measurement, options.surface, threads)
    contrast = local_contrast(measurement, options.photometric, surface, fixed, threads)
    images = texture_images(measurement, surface, contrast, pitch_mm, options.charts, threads)
    return Textured(measurement, surface, contrast, images)


def prepare_textured(
    item: Textured, keypoints: Keypoints, options: PairOptions | None = None, threads: int | None = None
) -> Prepared:
    """Return what pairs need beyond texture images and keypoints: maps for patches and refinement."""
    options = options or PairOptions()
    measurement, surface, contrast = item.measurement, item.surface, item.contrast
    spacings, shading_mm = options.refine.spacing_px, options.photometric.shading_mm

    def make() -> tuple[Sides, Sides]:
        sides = joint_sides(measurement, surface, contrast, spacings, shading_mm, threads)
        return sides, _without(sides, held_out_pixels(measurement))

    patches, maps = patch_images(item.images), RefinementMaps(make)
    return Prepared(measurement, surface, contrast, item.images, patches, keypoints, maps, options.dense)


def prepare(
    measurement: Measurement,
    pitch_mm: float,
    options: PairOptions | None = None,
    threads: int | None = None,
    fixed: FixedPattern | None = None,
) -> Prepared:
    """Return surface, texture images, keypoints and refinement maps of one measurement.

    `fixed` is the pattern of its sensor (`estimate_fixed_patterns`), which is no texture.
    """
    options = options or PairOptions()
    textured = draw_texture(measurement, pitch_mm, options, threads, fixed)
    return prepare_textured(textured, detect_keypoints(textured.images, options.keypoints), options, threads)


def register_pair(
    a: Prepared, b: Prepared, options: PairOptions | None = None, pairs_in_run: int = 1, threads: int | None = None
) -> PairResult:
    """Return the judged transform of b in a; "cannot be registered" is a result with its reason."""
    options = options or PairOptions()
    matches = match(_patch_side(a), _patch_side(b), options.match, threads)
    coarse = find_consensus(matches, options.consensus, threads, search=_patch_search(a, options.match))
    result = _judged(a, b, matches, coarse, options, pairs_in_run, threads)
    if result.status != "refused" or not (options.dense.enabled and is_weak(a, b, options.dense)):
        return result
    windows = match_windows(a.dense, b.dense, options.consensus.tolerance_mm, options.dense, threads)
    search = Search(np.inf, windows.chance, windows.tried)
    coarse = find_consensus(windows.matches, options.consensus, threads, search=search)
    second = _judged(a, b, windows.matches, coarse, options, pairs_in_run, threads)
    # Of two refusals the one that says more.
    better = second.log10_false_alarms < result.log10_false_alarms
    return second if second.status != "refused" or better else result


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
    side_a, side_b = (Side(p.measurement, p.images, p.contrast) for p in (a, b))
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
    anchor = first.anchor() if is_weak(a, b, options.dense) else None
    # What agrees with a consensus does so within this.
    within_mm = options.verdict.verify.agree_mm
    refined = refine_pair(a, b, first.T_a_b, options, threads, verdict.without, anchor, within_mm)
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
    anchor: Anchor | None = None,
    within_mm: float = np.inf,
) -> Refined | None:
    """Return the joint refinement of a pair from a coarse transform, or None where the surfaces do not overlap.

    `without` (H, W) of a and of b are pixels that take no part; `anchor` adds what windows of weak textures say. The
    start is not farther off than `within_mm`.
    """
    options = options or PairOptions()
    extent = overlap_extent(a.measurement, b.measurement, T_a_b, max(options.refine.max_distance_mm))
    if extent is None:
        return None
    centre, radius = extent
    tile = tile_size_px(b.measurement)
    sides_a, sides_b = _without(a.fit_sides, without[0]), _without(b.sides, without[1])
    steps = options.refine.starting_within(within_mm, ground_sample_distance(b.measurement))
    return refine(sides_a, sides_b, T_a_b, centre, radius, tile, steps, threads, anchor)


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
    only = _without({finest: a.sides[finest].without(~held_out_pixels(a.measurement))}, without[0])
    side_b = _without({finest: b.sides[finest]}, without[1])[finest]
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
        _without({finest: p.sides[finest]}, mask)[finest] for p, mask in zip((a, b), without, strict=True)
    )
    return fit_statistics(side_a, side_b, refined, options.refine, thread_count(threads))


def _without(sides: Sides, mask: NDArray[np.bool_] | None) -> Sides:
    return sides if mask is None else {n: side.without(mask) for n, side in sides.items()}


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
