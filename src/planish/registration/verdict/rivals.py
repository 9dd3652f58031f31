"""First against second: does the texture repeat, did two things move, or is the second explained by the first?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from planish.geometry import Array, rotation_angle, transform_points
from planish.registration.verdict.false_alarms import dispersion, log10_binomial_tail
from planish.registration.verdict.hypothesis import Hypothesis

#: "repeats": both explain the same places equally well; "two motions": each explains places of its own; "first",
#: "other": one of them explains the places significantly better; "weak": the windows do not speak for the other.
Relation = Literal["repeats", "two motions", "first", "other", "weak"]


@dataclass(frozen=True)
class Rivalry:
    """How another motion relates to the first.

    Parameters
    ----------
    relation : str
    shared : int
        Windows that both explain.
    own : int
        Windows that the other alone explains.
    log10_chance : float
        log10 of the chance that the better of both explains the windows of both so often better, if both were equal.
    """

    relation: Relation
    shared: int
    own: int
    log10_chance: float


def compare(first: Hypothesis, other: Hypothesis, log10_significant: float) -> Rivalry:
    """Return what the windows say of two motions.

    In the windows that both predict, the heights of the correlation are compared one by one (sign test): of a pattern
    that repeats exactly each is as good as the other, while grain between the print, or a texture that only resembles
    itself, speaks for one.
    """
    if other.log10_by_windows > log10_significant:
        return Rivalry("weak", 0, other.agreeing, 0.0)
    _, i, j = np.intersect1d(first.windows.cell, other.windows.cell, return_indices=True)
    agrees, agrees_other = first.windows.agrees[i], other.windows.agrees[j]
    shared, own = int((agrees & agrees_other).sum()), int((~agrees & agrees_other).sum())
    outside = other.agreeing - shared - own
    if shared < own + outside and shared < 0.5 * max(1, shared + own):
        return Rivalry("two motions", shared, own + outside, 0.0)
    decisive = agrees | agrees_other
    factor = max(dispersion(first.windows), dispersion(other.windows))
    trials = int(decisive.sum() / factor)
    wins = int((first.windows.score[i] > other.windows.score[j])[decisive].sum() / factor)
    better = max(wins, trials - wins)
    chance = min(0.0, log10_binomial_tail(better, trials, 0.5) + np.log10(2))
    scores = np.median(np.sort([first.windows.score[i][decisive], other.windows.score[j][decisive]], axis=0), axis=1)
    if chance > log10_significant or scores[0] > _CLEARLY * scores[1]:
        return Rivalry("repeats", shared, own + outside, chance)
    return Rivalry("first" if 2 * wins >= trials else "other", shared, own + outside, chance)


#: Windows of one pattern seen at two places of an image differ in sharpness and noise: what is really one of two equal
#: things may score so much lower, in the median.
_CLEARLY = 0.9


def alike(first: Hypothesis, other: Hypothesis, points_b: Array, apart_mm: float) -> bool:
    """Return whether two motions are the same within what a coarse transform is good for."""
    shift = transform_points(first.T_a_b, points_b) - transform_points(other.T_a_b, points_b)
    turn = rotation_angle(first.T_a_b[:3, :3].T @ other.T_a_b[:3, :3])
    return bool(np.median(np.linalg.norm(shift, axis=1)) < apart_mm and turn < _ALIKE_RAD)


#: Two coarse transforms of one motion differ by less [rad].
_ALIKE_RAD = 0.05
