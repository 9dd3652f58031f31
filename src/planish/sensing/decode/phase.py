"""N-step phase shift to absolute projector positions with their standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish import _core
from planish.measurement import Map, NoiseModel, rejection_bit
from planish.options import Options
from planish.sensing.entries import Axis
from planish.sensing.images import GreyImage
from planish.sensing.sequence import AxisCode

#: Neighbours that differ by more than so many standard deviations lie on different surfaces.
AGREEMENT_SIGMAS = 5.0
NOTHING: Map = np.empty((0, 0), np.float32)


class DecodeOptions(Options):
    """Options of decoding.

    Parameters
    ----------
    max_phase_sigma_rad : float
        Pixels whose finest phase is less certain are rejected as dark.
    """

    max_phase_sigma_rad: float = Field(default=0.25, gt=0, le=1)


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
        Positions by Gray code, in phase with the fringes; needed where the axis has a Gray code.

    Notes
    -----
    I_k = A + B cos(phi - sign 2 pi k / N); position = phi P / (2 pi) + whole periods P, which come from the next longer
    period or the Gray code. sigma = P / (2 pi) sqrt(2 / N) sigma_I / B. Steps at saturation are left out, the rest is
    solved by least squares. Single pixels with a wrong number of whole periods take that of their neighbours; no phase
    is changed by them.
    """
    angles = [angle for period in code.periods for angle in period.angles]
    extent, longest = code.extent_px, code.periods[0].period_px
    # The longest period is absolute from half a pixel before the first projector pixel on, with the spare halved.
    start = -0.5 - (0.5 * (longest - extent) if extent is not None else 0.0)
    gray = code.gray
    # Half a cell is what a right code may be off; the limit lies half-way between that and a slip.
    coarse_limit = 0.25 * (longest + gray.cell_px) if gray is not None else 0.0
    position, sigma, mean, modulation, rejected = _core.decode_phase(
        [images[i] for i in code.phase_images],
        [len(period.images) for period in code.periods],
        [float(np.cos(angle)) for angle in angles],
        [float(np.sin(angle)) for angle in angles],
        [period.period_px for period in code.periods],
        NOTHING if coarse_px is None else coarse_px,
        saturation,
        noise.offset,
        noise.slope,
        options.max_phase_sigma_rad,
        coarse_limit,
        start,
        longest if gray is None else 0.0,
        threads,
    )
    # One phase step from pixel to pixel is what neighbours on one surface may differ by.
    tolerance = position_slope(np.where(rejected == 0, position, np.float32(np.nan)))
    position, sigma, rejected = _core.repair_periods(
        position, sigma, rejected, code.periods[-1].period_px, tolerance, AGREEMENT_SIGMAS, threads
    )
    return PhaseMap(code.axis, position, sigma, rejected), mean, modulation


def position_slope(position_px: NDArray[np.float32], sample: int = 8) -> float:
    """Return the median change of position (H, W) from pixel to pixel [projector px per px] along the steeper axis."""
    slopes = [0.0]
    for lines in (position_px[::sample], position_px[:, ::sample].T):
        steps = np.abs(np.diff(lines, axis=1))
        if (known := steps[np.isfinite(steps)]).size:
            slopes.append(float(np.median(known)))
    return max(slopes)
