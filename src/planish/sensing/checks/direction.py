"""Whether fringes run the way the Gray code says: beside half-period cells nothing else contradicts a wrong sign."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish.sensing.decode import PhaseMap

#: Image lines that are looked at.
LINES = 64
#: Windows over so many periods, of at least and at most so many pixels (the latter as a share of the line).
WINDOW_PERIODS, MIN_WINDOW_PX, MAX_WINDOW = 2.0, 8, 0.5
#: Positions that run backwards within each cell and leap on to the next one make 2 to 3 times the way; right ones 1.
DETOUR = 1.5
#: ... and noise little more, where a pixel's step is so many standard deviations.
STEP_SIGMAS = 4.0
#: Fewer windows say nothing.
MIN_WINDOWS = 200


def backward_share(phase: PhaseMap, period_px: float) -> float:
    """Return the share of the windows along image lines in which positions run back and forth; 0 where too few tell.

    Parameters
    ----------
    phase : PhaseMap
        Positions (H, W), counted by a Gray code.
    period_px : float
        Of the finest fringes [projector px].

    Notes
    -----
    With cells of half a period, fringes of the wrong sign lie within a quarter of a period of their cells' centres, as
    right ones do: the place where the fringes start is found from the capture, and takes up the rest. But they run
    backwards in each cell. The way sum |x_(i+1) - x_i| over a window is compared with the distance of its ends.
    """
    x, sigma = _lines(phase)
    steps = np.abs(np.diff(x, axis=1))
    known = np.isfinite(steps)
    if not known.any():
        return 0.0
    step = float(np.median(steps[known]))
    longest = int(MAX_WINDOW * x.shape[1])
    length = min(max(MIN_WINDOW_PX, int(np.ceil(WINDOW_PERIODS * period_px / max(step, 1e-6)))), longest)
    if length < MIN_WINDOW_PX:
        return 0.0
    way = np.cumsum(np.pad(np.where(known, steps, 0), ((0, 0), (1, 0))), axis=1)
    gaps = np.cumsum(np.pad(~known, ((0, 0), (1, 0))), axis=1)
    way, gaps = (total[:, length:] - total[:, :-length] for total in (way, gaps))
    distance = np.abs(x[:, length:] - x[:, :-length])
    noise = np.maximum(sigma[:, length:], sigma[:, :-length])
    with np.errstate(invalid="ignore"):
        clear = (gaps == 0) & (distance > 0.5 * period_px) & (distance > STEP_SIGMAS * length * noise)
    if np.count_nonzero(clear) < MIN_WINDOWS:
        return 0.0
    return float((way[clear] > DETOUR * distance[clear]).mean())


def _lines(phase: PhaseMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions and their sigma (lines, n) of some image lines, along which positions change more."""
    maps = [m[:: max(1, m.shape[0] // LINES)].astype(float) for m in (phase.position_px, phase.sigma_px)]
    turned = [m.T[:: max(1, m.shape[1] // LINES)].astype(float) for m in (phase.position_px, phase.sigma_px)]
    found = max((maps, turned), key=lambda item: _median_step(item[0]))
    return found[0], found[1]


def _median_step(x: NDArray[np.float64]) -> float:
    steps = np.abs(np.diff(x, axis=1))
    known = steps[np.isfinite(steps)]
    return float(np.median(known)) if known.size else 0.0
