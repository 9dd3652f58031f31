"""The spread of errors that single outliers do not change."""

import numpy as np


def robust_spread(values) -> float:
    """1.4826 times the median absolute deviation: the standard deviation, were they normal."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))
