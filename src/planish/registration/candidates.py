"""Which pairs of measurements are tried."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import combinations

from planish.registration.keypoints.keypoints import Keypoints


def candidate_pairs(keypoints: Mapping[str, Keypoints], new: Collection[str] | None = None) -> list[tuple[str, str]]:
    """Return the pairs (a, b) of names, a < b, that are worth trying, sorted: all of them.

    Parameters
    ----------
    keypoints : mapping of Keypoints
        By the name of the measurement; may read each from its file when it is asked for.
    new : collection of str, optional
        Only pairs with one of these: the others have been tried.
    """
    pairs = combinations(sorted(keypoints), 2)
    return [pair for pair in pairs if new is None or pair[0] in new or pair[1] in new]
