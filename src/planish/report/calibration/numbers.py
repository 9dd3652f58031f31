"""Numbers as a reader wants them: as many digits as their standard deviation allows."""

from __future__ import annotations

import math
import re
from html import escape

#: Digits after the point beyond which no number of a calibration is read.
MOST_DIGITS = 9
#: Residuals below this have one digit more [px].
FEW_PIXELS = 0.02


def digits_for(sigma: float) -> int:
    """Return the digits after the point that show two significant ones of `sigma`."""
    if not (math.isfinite(sigma) and sigma > 0):
        return 4
    return min(MOST_DIGITS, max(0, 1 - math.floor(math.log10(sigma))))


def with_sigma(value: float, sigma: float | None) -> tuple[str, str]:
    """Return value and standard deviation with the same digits after the point."""
    if sigma is None or not sigma > 0:
        return f"{value:.4g}", ""
    digits = digits_for(sigma)
    return f"{value:.{digits}f}", f"{sigma:.{digits}f}"


def significant(value: float, digits: int = 2) -> str:
    """Return a number with so many significant digits and without an exponent; "-" where it is not known."""
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    places = min(MOST_DIGITS, max(0, digits - 1 - math.floor(math.log10(abs(value)))))
    return f"{value:.{places}f}"


def pixel_digits(value_px: float) -> int:
    """Return the digits after the point with which residuals of this size are shown."""
    return 3 if not value_px < FEW_PIXELS else 4


def pixels(value_px: float | None) -> str:
    """Return a residual [px]; "–" where it is not known."""
    if value_px is None or not math.isfinite(value_px):
        return "–"
    return f"{value_px:.{pixel_digits(value_px)}f}"


def prose(text: str) -> str:
    """Return text as HTML in which no line ends between a number and its unit."""
    return re.sub(r"(\d) (mm|px|%|°|±)", "\\1&nbsp;\\2", escape(text))


def percent(share: float) -> str:
    """Return a share in per cent."""
    return f"{significant(100 * share)} %"
