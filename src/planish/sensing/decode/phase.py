"""N-step phase shift to absolute projector positions with their standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish import _core
from planish.measurement import Map, NoiseModel, rejection_bit
from planish.options import Options
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import AxisCode
from planish.sensing.decode.disagreement import PhaseStack, expected_disagreement
from planish.sensing.patterns.entries import Axis

#: Neighbours that differ by more than so many standard deviations lie on different surfaces.
AGREEMENT_SIGMAS = 5.0
#: Of the 5 x 5 pixels around, so many must be suspected of inter-reflection too: all on one side of a border.
REFLECTION_PIXELS = 15
#: The slope of the positions is taken from so many lines at least.
MIN_LINES = 16


class DecodeOptions(Options):
    """Options of decoding.

    Parameters
    ----------
    max_phase_sigma_rad : float
        Pixels whose finest phase is less certain are rejected as dark.
    reflection_sigmas : float
        Coarse and fine fringes that disagree by more standard deviations, over an area, are rejected for
        inter-reflection.
    """

    max_phase_sigma_rad: float = Field(default=0.25, gt=0, le=1)
    reflection_sigmas: float = Field(default=4.0, gt=0)


@dataclass(frozen=True)
class PhaseMap:
    """Where the projector pixel lies that lights each pixel of one camera.

    Parameters
    ----------
    axis : "u" or "v"
        Projector axis.
    position_px : ndarray (H, W) float32
        Absolute position [projector px]; NaN where rejected. float32 resolves 1e-4 px at 1280 px, a five-hundredth of
        the noise of a good capture.
    sigma_px : ndarray (H, W) float32
        Its standard deviation [projector px].
    rejected : ndarray (H, W) uint16
        Bit mask of measurement.REJECTIONS.
    local_mean_gain : float
        Standard deviation of a local mean of positions over what independent errors would give: 1 for phases.
    """

    axis: Axis
    position_px: Map = field(metadata={"unit": "projector px"})
    sigma_px: Map = field(metadata={"unit": "projector px"})
    rejected: NDArray[np.uint16] = field(metadata={"unit": "bit mask of REJECTIONS"})
    local_mean_gain: float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the pixel grid."""
        return (self.position_px.shape[0], self.position_px.shape[1])

    def at(self, pixels: NDArray[np.intp]) -> PhaseMap:
        """Return the map of some pixels: flat indices of any shape (h, w)."""
        position, sigma = (m.ravel()[pixels] for m in (self.position_px, self.sigma_px))
        return replace(self, position_px=position, sigma_px=sigma, rejected=self.rejected.ravel()[pixels])

    def without(self, pixels: NDArray[np.bool_], reason: str) -> PhaseMap:
        """Return the map with `pixels` (H, W) rejected for a reason of measurement.REJECTIONS."""
        bit = rejection_bit(reason)
        position = np.where(pixels, np.float32(np.nan), self.position_px)
        sigma = np.where(pixels, np.float32(np.nan), self.sigma_px)
        rejected = self.rejected | np.where(pixels, bit, np.uint16(0))
        return replace(self, position_px=position, sigma_px=sigma, rejected=rejected)


def decode(
    images: Sequence[GreyImage],
    code: AxisCode,
    noise: NoiseModel,
    saturation: float,
    options: DecodeOptions,
    threads: int,
    coarse_px: Map | None = None,
    coarse_offset_px: float = 0.0,
) -> tuple[PhaseMap, Map, Map]:
    """Return the absolute projector position of every pixel of one camera, and mean and amplitude of its fringes.

    Parameters
    ----------
    images : sequence of ndarray (H, W), uint8 or uint16
        All images of the camera in the order of the sequence.
    code : AxisCode
        What they show; at least one period.
    noise : NoiseModel
        Variance of a grey value.
    saturation : float
        Grey level at and above which a step is not used.
    options : DecodeOptions
        Limits.
    threads : int
        Number of threads; the result does not depend on it.
    coarse_px : ndarray (H, W) or None
        Positions by Gray code; needed where the axis has a Gray code.
    coarse_offset_px : float
        By how much they exceed the positions by phase.

    Notes
    -----
    I_k = A + B cos(phi - sign 2 pi k / N); position = phi P / (2 pi) + whole periods P, which come from level to level
    of the code's ladder, or from the Gray code. sigma = P / (2 pi) sqrt(2 / N) sigma_I / B. Steps at saturation are
    left out, the rest is solved by least squares. Single pixels with a wrong number of whole periods take that of their
    neighbours; no phase is changed by them.
    """
    stack = PhaseStack.of([images[i] for i in code.phase_images], code, coarse_px)
    settings = _settings(code, noise, saturation, options, coarse_offset_px)
    settings["expected"] = expected_disagreement(stack, settings, code, threads)
    position, sigma, mean, modulation, rejected = _core.decode_phase(*stack.arguments, settings, threads)
    # One phase step from pixel to pixel is what neighbours on one surface may differ by.
    _core.repair_periods(
        position,
        sigma,
        rejected,
        finest_period(code),
        position_slope(position),
        AGREEMENT_SIGMAS,
        REFLECTION_PIXELS,
        threads,
    )
    return PhaseMap(code.axis, position, sigma, rejected), mean, modulation


def finest_period(code: AxisCode) -> float:
    """Return the period [projector px] of the last level."""
    assert code.ladder is not None
    return code.ladder.levels[-1].period_px


def _settings(
    code: AxisCode, noise: NoiseModel, saturation: float, options: DecodeOptions, coarse_offset_px: float
) -> dict[str, Any]:
    assert code.ladder is not None
    first = code.ladder.levels[0].period_px
    gray = code.gray
    # A first level that is absolute begins half a pixel before the first projector pixel, with the spare halved.
    spare = first - code.extent_px if code.extent_px is not None else 0.0
    return {
        "saturation": saturation,
        "noise_offset": noise.offset,
        "noise_slope": noise.slope,
        "max_phase_sigma_rad": options.max_phase_sigma_rad,
        "coarse_offset_px": coarse_offset_px,
        # Half a cell is what a right code may be off; the limit lies half-way between that and a slip.
        "coarse_limit_px": 0.25 * (first + gray.cell_px) if gray is not None else 0.0,
        "range_start_px": -0.5 - 0.5 * spare,
        "range_length_px": first if gray is None else 0.0,
        "level_coefficients": [list(level.coefficients) for level in code.ladder.levels],
        "level_periods_px": [level.period_px for level in code.ladder.levels],
        "averaged": list(code.ladder.averaged),
        "reflection_sigmas": options.reflection_sigmas,
    }


def position_slope(position_px: NDArray[np.float32], sample: int = 64) -> float:
    """Return the median change of position (H, W) from pixel to pixel [projector px per px] along the steeper axis.

    Every `sample`-th line of the map is looked at, more of a small one.
    """
    slopes = [0.0]
    for lines in (position_px, position_px.T):
        steps = np.abs(np.diff(lines[:: max(1, min(sample, len(lines) // MIN_LINES))], axis=1))
        if (known := steps[np.isfinite(steps)]).size:
            slopes.append(float(np.median(known)))
    return max(slopes)
