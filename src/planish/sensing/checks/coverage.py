"""How much of what the projector lights became points, and why the rest did not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.measurement import Finding, count_reasons

#: A capture with fewer points than this share of the pixels that show patterns is worth a warning.
FEW_SHARE = 0.2
#: Every so many rows of large images are counted; all of them where something is wrong.
SAMPLED_ROWS, SAMPLED_FROM_PX = 4, 500_000
#: So many reasons are named, the most frequent first.
NAMED_REASONS = 3
#: What most likely lies behind a reason that outweighs the others.
LIKELY = {
    "masked": "mask or volume_mm leave out the part",
    "dark": "too little light, or the patterns are not seen",
    "saturated": "too much light or too long an exposure",
    "slip": "periods, signs or order of the sequence",
    "interreflection": "the part mirrors itself",
    "mixed": "cameras out of focus, or a very rough surface",
    "unmatched": "the cameras' calibration, cameras exchanged, or no common field of view",
    "mismatch": "the calibration of the rig, above all of the projector",
    "edge": "the part is seen at grazing incidence",
    "isolated": "noise: too little light",
    "ambiguous": "too few patterns, or too little light",
}


def check_coverage(rejected: NDArray[np.uint16], subject: str) -> Finding:
    """Return the share of the lit pixels (H, W) that became points.

    Raises
    ------
    InputError
        Where there is no point at all.
    """
    rows = SAMPLED_ROWS if rejected.size > SAMPLED_FROM_PX else 1
    reasons, share, pixels = _shares(rejected[::rows])
    if share < FEW_SHARE:
        reasons, share, pixels = _shares(rejected)
    first = max(reasons, key=lambda name: reasons[name], default="")
    if sum(reasons.values()) == rejected.size:
        raise InputError(
            subject, f"no point could be measured ({_text(reasons, pixels)})", f"points; most likely: {LIKELY[first]}"
        )
    warning = ""
    if share < FEW_SHARE:
        among_lit = {name: count for name, count in reasons.items() if name not in ("dark", "masked")}
        first = max(among_lit, key=lambda name: among_lit[name], default=first)
        warning = (
            f"only {100 * share:.1f} % of the lit pixels became points ({_text(reasons, pixels)}); most likely: "
            f"{LIKELY[first]}"
        )
    return Finding(
        "coverage", 100 * share, None, "% of the lit pixels", _text(reasons, pixels) or "none rejected", warning
    )


def _shares(rejected: NDArray[np.uint16]) -> tuple[dict[str, int], float, int]:
    """Return the counts per reason, the share of the lit pixels that are valid, and the number of all pixels."""
    reasons, pixels = {name: count for name, count in count_reasons(rejected).items() if count}, rejected.size
    lit = pixels - reasons.get("dark", 0) - reasons.get("masked", 0)
    return reasons, (pixels - sum(reasons.values())) / max(lit, 1), pixels


def _text(reasons: dict[str, int], pixels: int) -> str:
    named = sorted(reasons.items(), key=lambda item: -item[1])[:NAMED_REASONS]
    return ", ".join(f"{name} {100 * count / pixels:.1f} %" for name, count in named)
