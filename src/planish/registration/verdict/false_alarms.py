"""How many transforms this good chance alone would give: by the consensus, by what the consensus did not look at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betainc, gammaln

from planish.geometry import Array, transform_points
from planish.registration.consensus import Candidate, CoarseResult, count_places
from planish.registration.matches import Matches
from planish.registration.verdict.verify import Windows


def log10_false_alarms(places: int, all_places: int, chance: float, pairs_in_run: float) -> float:
    """Return log10 of the number of consensuses this good to be expected by chance in the whole run.

    A-contrario reasoning (Desolneux, Moisan, Morel 2000; Moulon et al. 2012): two matches fix the transform; the chance
    that `places - 2` or more of the other `all_places - 2` agree is a binomial tail; the number of transforms tried is
    that of pairs of matches, times the pairs of measurements of the run.
    """
    if places < 3:
        return float(np.log10(max(pairs_in_run, 1) * max(all_places, 2) ** 2 / 2))
    # Places are counted greedily: few of all can be fewer than those of a part of them.
    all_places = max(all_places, places)
    n, k = all_places - 2, places - 2
    tests = np.log10(pairs_in_run) + np.log10(all_places * (all_places - 1) / 2)
    return float(tests + log10_binomial_tail(k, n, chance))


def log10_binomial_tail(k: int, n: int, p: float) -> float:
    """Return log10 of the chance of k or more successes in n trials of chance p each."""
    if k <= 0:
        return 0.0
    tail = betainc(k, n - k + 1, p)  # P(X >= k) = I_p(k, n - k + 1)
    if tail > 1e-280:
        return float(np.log10(tail))
    # Below the range of doubles the first term of the tail bounds it within the factor 1 / (1 - p n / k).
    log_term = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1) + k * np.log(p) + (n - k) * np.log1p(-p)
    return float(min(log_term / np.log(10), 0.0))


def log10_by_matches(matches: Matches, candidate: Candidate, coarse: CoarseResult) -> float:
    """Return log10 of the number of consensuses this good to be expected by chance in one pair.

    Matches that were sought each by itself, in texture of its own, are independent, with a known chance. Of others,
    places count that are so far apart that their matches have looked at different texture: one piece of texture that
    resembles another by chance carries all the matches on it. A place agrees if one of its matches does.

    Of these, the greater of two counts. One is among all places (`chance_of_agreement`). The other grants chance that
    kind finds kind: rims match rims, lines match lines, because they look alike, so that a transform which lays one on
    the other has many matches that nearly agree. Only those within a wide reach are counted then, and the chance that
    such a match agrees exactly is taken from how the places of its neighbourhood lie: along a line it is far greater
    than in an area.
    """
    search, members, T_a_b = coarse.search, candidate.members, candidate.T_a_b
    if search.chance is not None:
        return log10_false_alarms(candidate.places, coarse.places, search.chance, search.tried)
    distance = np.linalg.norm(matches.points_a - transform_points(T_a_b, matches.points_b), axis=1)
    chance = _Chance(matches, T_a_b, coarse)
    best = 0.0
    for share in _TOLERANCES:
        agreeing = members[distance[members] <= share * coarse.options.tolerance_mm]
        best = min(best, chance.log10_tail(agreeing, share))
    several = np.log10(len(_TOLERANCES)) if best < 0 else 0.0
    return float(np.log10(max(coarse.places, 2) ** 2 / 2) + best + several)


#: Matches that agree far better than they need are less likely chance: shares of the tolerance that are tried
#: (adaptive thresholds: Moulon et al. 2012).
_TOLERANCES = (1.0, 0.5, 0.25)
#: Patches whose middles are so many radii apart share a seventh of their area.
_APART = 1.5


@dataclass(frozen=True)
class _Chance:
    """What chance explains of the agreement of matches with T_a_b; what all tolerances share is computed once."""

    matches: Matches
    T_a_b: Array
    coarse: CoarseResult

    def log10_tail(self, agreeing: NDArray[np.int64], share: float) -> float:
        """log10 of the chance that so many places agree within a share of the tolerance; two fix the transform."""
        places = self._places(self.matches.points_a[agreeing])
        if places < 3:
            return 0.0
        whole_chance = share**2 * self._of_agreement
        # Places are counted greedily: few of all can be fewer than those of a part of them.
        trials = [max(n, places) for n in self._all_places]
        # All matches of a place lead anywhere, each to a chance of its own; those that nearly agree lead the same way.
        of_place = min(1.0, whole_chance * max(1.0, len(self.matches) / trials[0])), self._nearly[1].within(share)
        return max(log10_binomial_tail(places - 2, n - 2, p) for n, p in zip(trials, of_place, strict=True))

    def _places(self, points: Array) -> int:
        return count_places(points, max(_APART * self.coarse.search.looked_at_mm, self.coarse.options.distinct_mm))

    @cached_property
    def _of_agreement(self) -> float:
        return chance_of_agreement(self.matches, self.T_a_b, self.coarse)

    @cached_property
    def _nearly(self) -> tuple[NDArray[np.bool_], _Neighbourhood]:
        return _nearly_agreeing(self.matches, self.T_a_b, self.coarse)

    @cached_property
    def _all_places(self) -> tuple[int, int]:
        """Places of all matches, and of those that nearly agree."""
        return self._places(self.matches.points_a), self._places(self.matches.points_a[self._nearly[0]])


@dataclass(frozen=True)
class _Neighbourhood:
    """Distances of neighbours' partners (n,) from matches that nearly agree, in tolerances."""

    tolerances: Array

    def within(self, share: float) -> float:
        """Return the chance that a match that nearly agrees does so exactly, within a share of the tolerance."""
        even = (share * _FREEDOM / _NEARLY_TOLERANCES) ** 2
        agree = np.count_nonzero(self.tolerances <= share * _FREEDOM)
        return float(max((agree + _PRIOR_PAIRS * even) / (len(self.tolerances) + _PRIOR_PAIRS), even))


#: The density of places near a place is averaged over this many tolerances.
_DENSITY_TOLERANCES = 5.0
#: Matches nearly agree within this many tolerances: many times as far as chance reaches, and well inside a part.
_NEARLY_TOLERANCES = 20.0
#: Half a tolerance of freedom that the fit takes.
_FREEDOM = 1.5
#: The chance of an even area counts as much as this many observed pairs of neighbours.
_PRIOR_PAIRS = 10


def chance_of_agreement(matches: Matches, T_a_b: Array, coarse: CoarseResult) -> float:
    """Return the chance that a match that has nothing to do with T_a_b agrees with it all the same.

    Each place of b is taken together with the partners of all other matches: what agrees then does so by chance, with
    the places as clustered and the orientations as alike as they are (keypoints of a brushed surface share one
    direction). Not less than the chance for orientations of any direction (`coarse.chance`).
    """
    n, options = len(matches), coarse.options
    if n < 3:
        return 1.0
    moved = np.asarray(transform_points(T_a_b, matches.points_b), float)
    i, j = _pairs_within(matches.points_a, moved, _DENSITY_TOLERANCES * options.tolerance_mm)
    density = float(_turned_alike(matches, T_a_b, i, j, coarse).sum()) / (n * (n - 1))
    return float(np.clip(max(density * (_FREEDOM / _DENSITY_TOLERANCES) ** 2, coarse.chance), 1e-12, 1.0))


def _nearly_agreeing(matches: Matches, T_a_b: Array, coarse: CoarseResult) -> tuple[NDArray[np.bool_], _Neighbourhood]:
    """Which matches (M,) nearly agree, and what tells the chance that one of them agrees exactly."""
    options = coarse.options
    reach = _NEARLY_TOLERANCES * options.tolerance_mm
    moved = np.asarray(transform_points(T_a_b, matches.points_b), float)
    own = np.arange(len(matches))
    near = np.linalg.norm(matches.points_a - moved, axis=1) <= reach
    near &= _turned_alike(matches, T_a_b, own, own, coarse)
    points_a, moved = matches.points_a[near], moved[near]
    i, j = _pairs_within(points_a, points_a, reach)
    return np.asarray(near), _Neighbourhood(np.linalg.norm(points_a[i] - moved[j], axis=1) / options.tolerance_mm)


def _pairs_within(a: Array, b: Array, reach: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (i, j), i != j, of points of a and b within `reach` of each other."""
    found = cKDTree(a).sparse_distance_matrix(cKDTree(b), reach, output_type="coo_matrix") if len(a) else None
    if found is None:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    other = found.row != found.col
    return found.row[other], found.col[other]


def _turned_alike(
    matches: Matches, T_a_b: Array, i: NDArray[np.intp], j: NDArray[np.intp], coarse: CoarseResult
) -> NDArray[np.bool_]:
    """Whether the frames of places i of a and j of b agree under T_a_b in orientation and normal."""
    turned = T_a_b[:3, :3] @ matches.frames_b[j]
    frames = matches.frames_a[i]
    orientation = (frames[:, :, 0] * turned[:, :, 0]).sum(1) >= np.cos(coarse.options.frame_angle_rad)
    normal = (frames[:, :, 2] * turned[:, :, 2]).sum(1) >= np.cos(coarse.options.normal_angle_rad)
    return np.asarray(orientation & normal)


def log10_by_windows(windows: Windows) -> float:
    """Return log10 of the chance that so many windows agree where the textures have nothing to do with each other.

    Under chance a peak stands anywhere in the search area. Where textures are alike over more than a window (lines,
    streaks, patterns), peaks come in clusters: numbers are divided by their dispersion. Asked is also the sum of the
    correlations (`Together`), for weak texture whose peaks are lost in noise. All windows are asked, and those of the
    most signal, which does not depend on where the peaks stand; the best counts, times the number of tests.
    """
    factor = dispersion(windows)
    order = np.argsort(-windows.richness, kind="stable")
    tails = []
    for share in _RICHEST:
        richest = order[: int(np.ceil(share * len(order)))]
        agrees = windows.agrees[richest]
        trials = int(len(agrees) / factor)
        tails.append(log10_binomial_tail(min(trials, int(agrees.sum() / factor)), trials, windows.chance))
        tails.append(windows.together.take(richest).log10_chance())
    return float(min(0.0, min(tails) + np.log10(len(tails))))


#: Shares of the windows, those of the most signal first: sparse marks on a blank part fill few windows.
_RICHEST = (1.0, 0.5, 0.25, 0.125)


def dispersion(windows: Windows) -> float:
    """Return how many times the peaks of windows that do not agree cluster beyond chance, at least 1.

    Index of dispersion (variance over mean) of the peaks' numbers in cells as large as the area of agreement.
    """
    others = windows.offset_mm[~windows.agrees]
    # Fewer peaks than cells say nothing about their clustering.
    cells_a_side = max(1, round(1 / np.sqrt(windows.chance)))
    if len(others) < cells_a_side**2:
        return 1.0
    reach = np.abs(windows.offset_mm).max() + 1e-9
    column, row = ((others + reach) / (2 * reach) * cells_a_side).astype(int).T
    all_counts = np.bincount(row * cells_a_side + column, minlength=cells_a_side**2)
    rows, columns = np.divmod(np.arange(cells_a_side**2), cells_a_side)
    # The cells that the area of agreement touches lack what agrees.
    middle = (cells_a_side - 1) / 2
    counts = all_counts[np.hypot(rows - middle, columns - middle) >= 1.5]
    mean = counts.mean()
    # Less than three standard deviations of the index above 1 (sqrt(2 / cells)) is chance.
    index = float(counts.var(ddof=1) / mean) if mean > 0 else 1.0
    return index if index > 1 + 3 * np.sqrt(2 / len(counts)) else 1.0


def log10_of_product(log10_p: float, log10_q: float) -> float:
    """Return log10 of the chance that the product of two independent chances is as small (Fisher 1925): x (1 - ln x).

    A number of false alarms serves as a chance where it is below 1: Markov's inequality.
    """
    log_x = (min(log10_p, 0.0) + min(log10_q, 0.0)) * np.log(10)
    return float((log_x + np.log1p(-log_x)) / np.log(10))


def log10_transforms(area_mm2: float, agree_mm: float) -> float:
    """Return log10 of how many transforms of two surfaces of this area windows can tell apart.

    Surfaces that lie on each other leave three freedoms: two shifts over the extent of both, in steps of what counts as
    agreement, and a turn whose step moves the rim by as much. No search can try more that differ.
    """
    extent = max(2 * np.sqrt(max(area_mm2, 0.0)), agree_mm)
    return float(2 * np.log10(extent / agree_mm) + np.log10(max(np.pi * extent / 2 / agree_mm, 1.0)))
