"""Consensus: the transform that the most matches agree on, without start value and without random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from planish import _core
from planish.geometry import Array, rotation_angle, transform_points
from planish.options import Options, thread_count
from planish.registration.matches import Matches


class ConsensusOptions(Options):
    """Options of the consensus."""

    #: Distance within which a match agrees with a transform [mm].
    tolerance_mm: float = Field(default=1.0, gt=0)
    #: Largest error of the rotation that a match's orientations give [rad].
    frame_angle_rad: float = Field(default=0.12, gt=0, lt=1.5)
    #: Largest error of the rotation that its normals give [rad].
    normal_angle_rad: float = Field(default=0.12, gt=0, lt=0.75)
    #: Matches nearer than this are one place when a consensus is counted [mm].
    distinct_mm: float = Field(default=2.0, gt=0)
    #: Most transforms reported.
    max_candidates: int = Field(default=3, ge=1, le=10)


@dataclass(frozen=True)
class Search:
    """How the matches of a pair were sought: what chance could choose from.

    Parameters
    ----------
    looked_at_mm : float
        How far around its place a match has compared the texture [mm]; infinite where it was sought everywhere.
    chance : float or None
        Probability that a match that has nothing to do with a transform agrees with it all the same, where each was
        sought by itself, in texture of its own. None: it follows from how the places lie.
    tried : float
        Transforms that chance had to choose from before there were matches.
    """

    looked_at_mm: float = field(default=5.0, metadata={"unit": "mm"})
    chance: float | None = None
    tried: float = 1.0


@dataclass(frozen=True)
class Candidate:
    """One transform and the matches that agree with it in position, normal and orientation.

    Parameters
    ----------
    T_a_b : ndarray (4, 4)
        Maps points of b into a.
    members : ndarray (n,) int64
        Indices of the agreeing matches.
    places : int
        Distinct places among them.
    """

    T_a_b: Array
    members: NDArray[np.int64]
    places: int


@dataclass(frozen=True)
class CoarseResult:
    """Candidates of one pair, best first; each is the best that contradicts those before it.

    Parameters
    ----------
    candidates : tuple of Candidate
        None to `max_candidates`.
    chance : float
        Probability that a match that has nothing to do with a transform agrees with it all the same.
    places : int
        Distinct places among all matches (in a).
    search : Search
        How the matches were sought.
    options : ConsensusOptions
    """

    candidates: tuple[Candidate, ...]
    chance: float
    places: int
    search: Search = field(default_factory=Search)
    options: ConsensusOptions = field(default_factory=ConsensusOptions)


def find_consensus(
    matches: Matches,
    options: ConsensusOptions | None = None,
    threads: int | None = None,
    exclude: NDArray[np.bool_] | None = None,
    search: Search | None = None,
) -> CoarseResult:
    """Return the best transforms of b in a; `exclude` (M,) leaves matches out, `search` tells how they were sought."""
    options, search = options or ConsensusOptions(), search or Search()
    use = np.arange(len(matches)) if exclude is None else np.flatnonzero(~exclude)
    points_a, points_b = matches.points_a, matches.points_b
    chance = _chance(points_a[use], options) if search.chance is None else search.chance
    places = count_places(points_a[use], options.distinct_mm)
    candidates: list[Candidate] = []
    while len(candidates) < options.max_candidates:
        found = _best(matches, use, candidates, options, thread_count(threads))
        if found is None:
            break
        candidates.append(found)
        # What contradicts the best must live without the matches that lie anywhere near it.
        near = np.linalg.norm(points_a - transform_points(found.T_a_b, points_b), axis=1) < 3 * options.tolerance_mm
        use = use[~near[use]]
    return CoarseResult(tuple(candidates), chance, places, search, options)


#: Transforms that the core returns, by its count of cells; the places are counted here.
_KEPT = 5


def _best(
    matches: Matches, use: NDArray[np.int64], known: Sequence[Candidate], options: ConsensusOptions, threads: int
) -> Candidate | None:
    """Return the transform of the most places among the matches `use` that none of the known ones is like."""
    if len(use) < 3:
        return None
    asked = matches.take(use)
    points_a, points_b, frames_a, frames_b = asked.points_a, asked.points_b, asked.frames_a, asked.frames_b
    transforms, _ = _core.find_consensus(
        points_a, points_b, frames_a, frames_b, options.tolerance_mm, options.frame_angle_rad, options.normal_angle_rad,
        options.distinct_mm, _KEPT, threads,
    )  # fmt: skip
    best: Candidate | None = None
    for T in transforms:
        members = _members(T, points_a, points_b, frames_a, frames_b, options)
        places = count_places(points_a[members], options.distinct_mm)
        if places < 3 or (best is not None and places <= best.places):
            continue
        if not any(_alike(other.T_a_b, T, points_b, options) for other in known):
            best = Candidate(T, use[members], places)
    return best


def _members(
    T: Array, points_a: Array, points_b: Array, frames_a: Array, frames_b: Array, options: ConsensusOptions
) -> NDArray[np.int64]:
    """Matches that agree with T in position, normal and orientation."""
    distance = np.linalg.norm(points_a - transform_points(T, points_b), axis=1)
    turned = T[:3, :3] @ frames_b
    normal = np.einsum("mi,mi->m", frames_a[:, :, 2], turned[:, :, 2])
    orientation = np.einsum("mi,mi->m", frames_a[:, :, 0], turned[:, :, 0])
    good = (
        (distance <= options.tolerance_mm)
        & (normal >= np.cos(options.normal_angle_rad))
        & (orientation >= np.cos(options.frame_angle_rad))
    )
    return np.flatnonzero(good)


def count_places(points: Array, distinct_mm: float) -> int:
    """Return how many of points (N, 3) are at least `distinct_mm` apart, chosen greedily in their order."""
    return _core.count_places(np.ascontiguousarray(points, float), distinct_mm)


def _chance(points_a: Array, options: ConsensusOptions) -> float:
    """Probability that a random match agrees: it leads to a place within the tolerance, and is turned alike.

    The places' own clustering is counted in, and half a tolerance of freedom that the fit takes; never less than for
    places spread over a square of their extent.
    """
    n = len(points_a)
    if n < 3:
        return 1.0
    r = 1.5 * options.tolerance_mm
    tree = cKDTree(points_a)
    pairs = (tree.count_neighbors(tree, r) - n) / (n * (n - 1))
    extent = np.ptp(points_a, axis=0)
    area = float(np.prod(np.sort(extent)[1:])) + 1e-9
    position = max(pairs, min(1.0, np.pi * r**2 / area))
    return float(np.clip(position * options.frame_angle_rad / np.pi, 1e-12, 1.0))


def _alike(T: Array, other: Array, points_b: Array, options: ConsensusOptions) -> bool:
    shift = np.linalg.norm(transform_points(T, points_b) - transform_points(other, points_b), axis=1)
    turn = rotation_angle(T[:3, :3].T @ other[:3, :3])
    return bool(np.median(shift) < 5 * options.tolerance_mm and turn < 0.05)
