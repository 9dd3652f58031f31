"""How large a change of the orientation the row errors suggest, by the marginal likelihood.

A change x of the orientation with standard deviation s per kind, seen with information A as x^: the row errors have the
log likelihood L(s) = -1/2 log |1 + R A R| + 1/2 (R A x^)' (1 + R A R)^-1 (R A x^), R = diag(s), but for a constant
(Bishop, Pattern Recognition and Machine Learning, 2006, 3.5 and 7.2: automatic relevance determination).
"""

from __future__ import annotations

import numpy as np

from planish.geometry import Array
from planish.sensing.rigcheck.estimates import Orientation

#: How large a change may have been [rad]: none, and powers from 1e-5 to 0.1.
SIZES_RAD = (0.0, *np.geomspace(1e-5, 0.1, 49))
#: A change is taken for real where it makes the row errors more likely by this much (natural logarithm); one of three
#: standard deviations does.
LEAST_GAIN = 3.0


def likely_size(found: Orientation) -> float:
    """Return the size [rad] of all changes alike that makes the row errors most likely; 0 for none."""
    count = len(found.change_rad)
    likely = [_log_likelihood(found, np.full(count, size)) for size in SIZES_RAD]
    best = int(np.argmax(likely))
    return SIZES_RAD[best] if likely[best] > LEAST_GAIN else 0.0


def likely_sizes(found: Orientation) -> Array:
    """Return a size [rad] for each change (5,): 0 for those that the row errors do not ask for.

    The change that gains most is added until none gains LEAST_GAIN; sizes of those added follow each other.
    """
    sizes = np.zeros(len(found.change_rad))
    for _ in range(2 * len(sizes)):
        now = _log_likelihood(found, sizes)
        trials = [(_best_of(found, sizes, k), k) for k in range(len(sizes)) if sizes[k] == 0]
        if not trials:
            break
        (gain, size), k = max(trials)
        if gain - now < LEAST_GAIN:
            break
        sizes[k] = size
        for other in np.flatnonzero(sizes):
            sizes[other] = _best_of(found, sizes, int(other))[1]
    return sizes


def _best_of(found: Orientation, sizes: Array, k: int) -> tuple[float, float]:
    """Log likelihood and size of the best size of change k, the others as they are."""
    trials = []
    for size in SIZES_RAD:
        trial = sizes.copy()
        trial[k] = size
        trials.append((_log_likelihood(found, trial), size))
    return max(trials)


def _log_likelihood(found: Orientation, sizes: Array) -> float:
    inner = np.eye(len(sizes)) + sizes[:, None] * found.information * sizes
    right = sizes * (found.information @ found.change_rad)
    return float(-0.5 * np.linalg.slogdet(inner)[1] + 0.5 * right @ np.linalg.solve(inner, right))
