"""Matches of keypoints: descriptors suggest them, the correlation of the patches decides and places them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.geometry import Array
from planish.options import Options, thread_count
from planish.registration.match.descriptors import nearest_neighbours
from planish.registration.match.patches import Alignment, PatchSearch, PatchSide, align_patches
from planish.registration.matches import Matches, no_matches


class MatchOptions(Options):
    """Options of the matching."""

    #: The texture has one metric scale: sizes of two matching keypoints agree within this factor.
    max_size_ratio: float = Field(default=1.4, ge=1)
    #: Most pairs of keypoints whose patches are compared, best descriptors first.
    max_candidates: int = Field(default=5000, ge=10)
    #: Radius of the compared patches [texture px]. What tells places apart grows with it, and so does the time.
    patch_radius_px: int = Field(default=12, ge=3, le=40)
    #: Largest error of a keypoint's place that the comparison makes good, along both axes [texture px].
    reach_px: int = Field(default=2, ge=0, le=10)
    #: Largest error of a keypoint's orientation that it makes good [rad].
    reach_rad: float = Field(default=0.25, ge=0, lt=1.6)
    #: Least correlation of the patches, in standard deviations of that of unrelated texture. The search takes the
    #: greatest of some 40 independent ones, which chance alone brings to 2.2 on average and beyond 3.5 once in 100.
    min_significance: float = Field(default=3.5, ge=0)
    #: Most matches that go on, most significant first.
    max_matches: int = Field(default=1000, ge=10)


#: Turning by a step moves the rim of a patch by this many pixels; the search meets every turn within half of it.
_RIM_STEP_PX = 1.25


def match(a: PatchSide, b: PatchSide, options: MatchOptions | None = None, threads: int | None = None) -> Matches:
    """Return the matches of two measurements' keypoints, the most significant correlation first.

    A match stands at the keypoint of a; its place and frame in b are what the aligned patches give, on b's surface.
    """
    options, count = options or MatchOptions(), thread_count(threads)
    if len(a.keypoints) == 0 or len(b.keypoints) == 0:
        return no_matches()
    near = nearest_neighbours(a.keypoints, b.keypoints, options.max_size_ratio, options.max_candidates, count)
    found = align_patches(a, b, near.index_a, near.index_b, _search(options), count)
    chosen = _chosen(near.index_a, near.index_b, found.significance, options)
    points_b, frames_b, pixels_b = _placed(b, near.index_b[chosen], found, chosen)
    at_a = a.keypoints.take(near.index_a[chosen])
    matches = Matches(
        at_a.points_sensor, points_b, at_a.frames_sensor, frames_b, at_a.pixels, pixels_b, found.correlation[chosen]
    )
    return matches.take(np.flatnonzero(np.isfinite(np.hstack([points_b, pixels_b])).all(1)))


def _search(options: MatchOptions) -> PatchSearch:
    step = _RIM_STEP_PX / options.patch_radius_px
    # Half a step beyond the last one is searched, too.
    turns = int(np.ceil(max(0.0, options.reach_rad / step - 0.5)))
    return PatchSearch(options.patch_radius_px, options.reach_px, turns, step)


def _chosen(
    index_a: NDArray[np.int64], index_b: NDArray[np.int64], significance: Array, options: MatchOptions
) -> NDArray[np.int64]:
    """Pairs that are the most significant of both their keypoints, in order of significance."""
    best_a = np.full(index_a.max() + 1, -np.inf)
    best_b = np.full(index_b.max() + 1, -np.inf)
    np.maximum.at(best_a, index_a, significance)
    np.maximum.at(best_b, index_b, significance)
    best = (significance == best_a[index_a]) & (significance == best_b[index_b])
    kept = np.flatnonzero(best & (significance >= options.min_significance))
    return kept[np.lexsort((index_b[kept], index_a[kept], -significance[kept]))][: options.max_matches]


def _placed(
    side: PatchSide, index: NDArray[np.int64], found: Alignment, chosen: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Points, frames and pixels of the aligned places in the images of keypoints `index`; NaN beside the surface."""
    chart = side.keypoints.chart[index]
    points, frames, pixels = np.empty((len(index), 3)), np.empty((len(index), 3, 3)), np.empty((len(index), 2))
    for number, image in enumerate(side.images):
        own = chart == number
        at = chosen[own]
        points[own], frames[own], pixels[own] = image.locate(found.chart_px[at], found.chart_angle_rad[at])
    return points, frames, pixels
