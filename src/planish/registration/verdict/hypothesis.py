"""A motion that the matches suggest, with what speaks for it: matches, windows, how it moves in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array, fit_rigid, invert, rotation_angle, transform_points
from planish.measurement import Measurement
from planish.registration.consensus import Candidate, CoarseResult
from planish.registration.matches import Matches
from planish.registration.texture.sampling import sample
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.false_alarms import (
    log10_by_matches,
    log10_by_windows,
    log10_of_product,
    log10_transforms,
)
from planish.registration.verdict.verify import (
    Windows,
    apart_from,
    correlate_windows,
)
from planish.registration.verdict.window_sizes import VerifyOptions, area_mm2, screening_step
from planish.rig import Camera


@dataclass(frozen=True)
class Drift:
    """How far a refinement left what agreed before it (rms) [mm], and how far it may."""

    mm: float
    limit_mm: float = np.inf


@dataclass(frozen=True)
class Hypothesis:
    """One motion of b into a with its evidence.

    Parameters
    ----------
    T_a_b : ndarray (4, 4)
        Fitted to matches and agreeing windows.
    members : ndarray (n,) int64
        Matches of the consensus.
    places : int
        Distinct places among them.
    points_a : ndarray (n, 3)
        Places of these matches [mm], in the frame of a.
    windows : Windows
        Of the common region that the motion predicts.
    log10_false_alarms : float
        Expected number of motions this good by chance, in one pair.
    log10_by_windows : float
        The same by all its windows alone, against all transforms there are.
    moved_px : float
        Median motion of what agrees, in the image of that camera, or on that of the projector, where it moved least.
    """

    T_a_b: Array
    members: NDArray[np.int64]
    places: int
    points_a: Array
    windows: Windows
    log10_false_alarms: float
    log10_by_windows: float
    moved_px: float

    @property
    def agreeing(self) -> int:
        """Number of agreeing windows."""
        return int(self.windows.agrees.sum())

    def drift(self, T_a_b: Array, pitch_mm: float) -> Drift:
        """Return by how much another transform misplaces what agrees.

        Each window was sought some millimetres around, so that their peaks do not lead to the nearest optimum, as
        slopes do, but to the highest. Optima of one texture lie a pixel of the texture images (`pitch_mm`) apart at
        least.
        """
        agrees = self.windows.agrees
        chosen = self.windows.points_a[agrees]
        fits = len(chosen) >= _MIN_WINDOWS
        points_a = chosen if fits else self.points_a
        if len(points_a) == 0:
            return Drift(0.0)
        moved = transform_points(T_a_b @ invert(self.T_a_b), points_a)
        mm = float(np.sqrt(((moved - points_a) ** 2).sum(1).mean()))
        if not fits:
            return Drift(mm)
        # Six unknowns from two coordinates of each window.
        sigma = float(np.sqrt((self.windows.offset_mm[agrees] ** 2).sum(1).mean() / 2 * 6 / (2 * len(chosen))))
        return Drift(mm, 0.5 * pitch_mm + _SURELY * sigma)


#: Standard deviations of the windows' fit that chance does not exceed.
_SURELY = 5.0
#: Transforms are fitted to what agrees at most so often.
_FITS = 3
#: Windows are fitted to where they agree so many times more often than by chance: else chance would draw the fit.
_CREDIBLE = 3.0
#: A smaller change (rms) alters neither which windows agree nor how well [texture px].
_SETTLED_PX = 0.15
#: As few agreeing windows as this fix a rigid motion with redundancy.
_MIN_WINDOWS = 6


def weigh(
    a: Side,
    b: Side,
    matches: Matches,
    candidate: Candidate,
    coarse: CoarseResult,
    options: VerifyOptions,
) -> Hypothesis:
    """Return what speaks for a candidate of the consensus.

    Two independent tests are multiplied: the agreement of the matches, and that of the windows which no match of
    the consensus has looked at. Where these are none, all windows are
    counted against all transforms that could have been tried. Of both ways the better counts, twice.
    """
    by_matches = log10_by_matches(matches, candidate, coarse)
    members = matches.take(candidate.members)
    reach = coarse.search.looked_at_mm + options.window_mm / 2
    # All candidates of a pair are weighed.
    several = float(np.log10(max(1, len(coarse.candidates))))

    def product(windows: Windows) -> float:
        free = windows.take(apart_from(windows, members.points_a, reach))
        return log10_of_product(by_matches, log10_by_windows(free)) + several

    T, exhaustive, every = candidate.T_a_b, np.inf, screening_step(a.images, options)
    # Of most pairs that do not overlap a part of the windows shows that nothing agrees. Where the matches alone say
    # enough, no window takes from that.
    if every > 1 and log10_of_product(by_matches, 0.0) + several >= 0:
        windows = correlate_windows(a, b, T, options, every)
        alarms = product(windows)
        worth_all = alarms < 0 or log10_by_windows(windows) < _WORTH_A_LOOK
    else:
        worth_all = True
    if worth_all:
        windows = correlate_windows(a, b, T, options)
        alarms = product(windows)
        T, windows = _fitted(a, b, members, T, windows, options)
        exhaustive = _exhaustive(a, b, windows, options)
    alarms = float(min(alarms, exhaustive) + np.log10(2))
    if alarms >= 0:
        # No evidence: the consensus alone says how far from significance it is.
        alarms = max(alarms, by_matches)
    return Hypothesis(
        T, candidate.members, candidate.places, members.points_a, windows, alarms, exhaustive,
        _moved_px(a.measurement, b.measurement, members, windows),
    )  # fmt: skip


#: log10 of the chance of the screened windows below which all are looked at.
_WORTH_A_LOOK = np.log10(0.2)


def _exhaustive(a: Side, b: Side, windows: Windows, options: VerifyOptions) -> float:
    """log10 of the false alarms of windows held against all transforms that could have been tried."""
    area = max(area_mm2(a.images), area_mm2(b.images))
    return log10_by_windows(windows) + log10_transforms(area, options.agree_mm)


def as_hypothesis(a: Side, b: Side, T_a_b: Array, options: VerifyOptions) -> Hypothesis:
    """Return what the windows alone say about a transform that no match suggested."""
    windows = correlate_windows(a, b, T_a_b, options)
    T, windows = _fitted(a, b, None, T_a_b, windows, options)
    alarms = _exhaustive(a, b, windows, options)
    return Hypothesis(
        T, np.empty(0, np.int64), 0, np.empty((0, 3)), windows, alarms, alarms,
        _moved_px(a.measurement, b.measurement, None, windows),
    )  # fmt: skip


def _fitted(
    a: Side, b: Side, members: Matches | None, T_a_b: Array, windows: Windows, options: VerifyOptions
) -> tuple[Array, Windows]:
    """Transform fitted to the agreeing windows, until it settles."""
    for _ in range(_FITS):
        points_a, points_b = _window_points(b.measurement, windows)
        if len(points_a) < max(_MIN_WINDOWS, _CREDIBLE * windows.chance * len(windows)):
            break
        if members is not None:
            points_a, points_b = (
                np.concatenate(x) for x in ((points_a, members.points_a), (points_b, members.points_b))
            )
        T = fit_rigid(points_a, points_b)
        shift = np.linalg.norm(transform_points(T, points_b) - transform_points(T_a_b, points_b), axis=1)
        if np.sqrt((shift**2).mean()) < _SETTLED_PX * a.images[0].pitch_mm:
            return T, windows
        again = correlate_windows(a, b, T, options)
        if again.agrees.sum() < windows.agrees.sum():
            break
        T_a_b, windows = T, again
    return T_a_b, windows


def _window_points(b: Measurement, windows: Windows) -> tuple[Array, Array]:
    """Points of a and b (n, 3) that the agreeing windows put together."""
    chosen = windows.agrees & np.isfinite(windows.found_b).all(1)
    points_a = windows.points_a[chosen]
    if len(points_a) == 0:
        return points_a, points_a
    points_b = sample(b.points_sensor, windows.found_b[chosen], nearest_outside=True).astype(float)
    known = np.isfinite(points_b).all(1)
    return points_a[known], points_b[known]


def _moved_px(a: Measurement, b: Measurement, members: Matches | None, windows: Windows) -> float:
    """Median motion of the agreeing windows, or of the matches where there are too few; each where it moved least.

    What is fixed to one device (a camera's dust, the projector's) stands still there, and moves in the others' images.
    """
    chosen = windows.agrees & np.isfinite(windows.found_b).all(1)
    if chosen.sum() >= _MIN_WINDOWS or members is None:
        pixels_a, pixels_b, points_a = windows.pixels_a[chosen], windows.found_b[chosen], windows.points_a[chosen]
        points_b = sample(b.points_sensor, pixels_b, nearest_outside=True).astype(float)
    else:
        pixels_a, pixels_b, points_a, points_b = members.pixels_a, members.pixels_b, members.points_a, members.points_b
    if len(pixels_a) == 0:
        return np.inf
    motions = [np.linalg.norm(pixels_a - pixels_b, axis=1)]
    for device_a, device_b in _other_devices(a, b):
        motions.append(np.linalg.norm(device_a.project(points_a) - device_b.project(points_b), axis=1))
    return float(np.nanmedian(np.nanmin(motions, axis=0)))


def _other_devices(a: Measurement, b: Measurement) -> list[tuple[Camera, Camera]]:
    """Return the devices besides the organising camera that both measurements were taken with."""
    names = [n for n in a.rig.cameras if n != a.organised_on and n in b.rig.cameras]
    pairs = [(a.rig.cameras[n], b.rig.cameras[n]) for n in names]
    if a.rig.projector is not None and b.rig.projector is not None:
        pairs.append((a.rig.projector, b.rig.projector))
    return [(x, y) for x, y in pairs if np.array_equal(x.kernel_parameters, y.kernel_parameters)]


def apart(first: Hypothesis, other: Hypothesis, centre_b: Array) -> tuple[float, float]:
    """Return how far apart two motions are: rotation [rad], translation at a point of b [mm]."""
    shift = transform_points(other.T_a_b, centre_b) - transform_points(first.T_a_b, centre_b)
    return rotation_angle(first.T_a_b[:3, :3].T @ other.T_a_b[:3, :3]), float(np.linalg.norm(shift))
