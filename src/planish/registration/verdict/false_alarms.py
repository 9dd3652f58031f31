"""How many consensuses this good chance alone would give."""

from __future__ import annotations

import numpy as np
from scipy.special import betainc, gammaln


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
    return float(tests + _log10_binomial_tail(k, n, chance))


def _log10_binomial_tail(k: int, n: int, p: float) -> float:
    tail = betainc(k, n - k + 1, p)  # P(X >= k) = I_p(k, n - k + 1)
    if tail > 1e-280:
        return float(np.log10(tail))
    # Below the range of doubles the first term of the tail bounds it within the factor 1 / (1 - p n / k).
    log_term = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1) + k * np.log(p) + (n - k) * np.log1p(-p)
    return float(log_term / np.log(10))
