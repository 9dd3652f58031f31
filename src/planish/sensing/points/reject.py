"""Which pixels are not to be trusted, each with the name of its reason (measurement.REJECTIONS)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish import _core
from planish.measurement import Map, rejection_bit
from planish.options import Options
from planish.rig import Camera
from planish.sensing.capture.manifest import Box
from planish.sensing.decode import PhaseMap, position_slope
from planish.sensing.points.triangulate import TriangulatedPoints

#: The lit part of a pixel lies at most so far from its centre [px].
RIM_PX = 0.5
#: Every such row and column tells how steep the positions are: of ten thousands of differences the median counts.
SLOPE_ROWS = 32


class RejectOptions(Options):
    """Options of rejection.

    Parameters
    ----------
    sigmas : float
        Standard deviations beyond which a difference is no noise.
    edge_px : float
        A jump of the position by more than a surface changes it over so many pixels is an edge.
    max_miss_px : float
        Largest distance between a point's image and its corresponding pixel, across the epipolar line.
    projector_px : float
        Disagreement with the projector's calibration that is allowed on top of noise.
    max_tilt_deg : float
        Steepest surface, against the line of sight, whose neighbouring pixels still count as connected.
    max_incidence_deg : float
        Surfaces seen more obliquely (angle of ray and normal) are rejected: a pixel covers a range of depths there.
    rim_sigmas : float
        Points beside an unlit pixel are rejected where half a pixel more or less would move them by more than so many
        standard deviations: the unlit part of a pixel shifts what it looks at.
    fill_sigma_ratio : float
        Points that the projector gives beside those of two cameras count where noise alone leaves them a sigma of at
        most so many times the median of those.
    min_island_pixels : int
        Connected regions with fewer pixels are rejected.
    """

    sigmas: float = Field(default=5.0, gt=0)
    edge_px: float = Field(default=1.0, gt=0)
    max_miss_px: float = Field(default=1.0, gt=0)
    projector_px: float = Field(default=1.0, ge=0)
    max_tilt_deg: float = Field(default=85.0, gt=0, lt=90)
    max_incidence_deg: float = Field(default=80.0, gt=0, lt=90)
    rim_sigmas: float = Field(default=3.0, gt=0)
    fill_sigma_ratio: float = Field(default=4.0, gt=0)
    min_island_pixels: int = Field(default=50, ge=1)


def reject_edges(phase: PhaseMap, options: RejectOptions, threads: int) -> PhaseMap:
    """Return the map without the pixels beside a jump: they mix two surfaces, and no interpolation may bridge them."""
    jump_px = options.edge_px * position_slope(phase.position_px, SLOPE_ROWS)
    position, sigma, rejected = _core.phase_edges(
        phase.position_px,
        phase.sigma_px,
        phase.rejected,
        jump_px,
        options.sigmas,
        int(rejection_bit("mixed")),
        threads,
    )
    return replace(phase, position_px=position, sigma_px=sigma, rejected=rejected)


def reject_points(
    found: TriangulatedPoints,
    phase: PhaseMap,
    own: Camera,
    projector: Camera | None,
    volume: Box | None,
    options: RejectOptions,
    threads: int,
) -> NDArray[np.uint16]:
    """Return the bit mask (H, W) of all reasons; 0 where a point is valid.

    Parameters
    ----------
    found : TriangulatedPoints
        Points of all pixels (H, W).
    phase : PhaseMap
        The organising camera's positions, with what has been rejected so far.
    own, projector : Camera
        The organising camera; the projector serves as an independent third ray where it is known.
    volume : Box or None
        Points outside are masked.
    options : RejectOptions
        Limits.
    threads : int
        Number of threads.
    """
    box = (np.full(3, -np.inf), np.full(3, np.inf)) if volume is None else (volume.min, volume.max)
    rejected, depth = _core.check_points(
        found.points_sensor,
        found.sigma_mm,
        found.miss_px,
        phase.position_px,
        phase.sigma_px,
        phase.rejected,
        own.kernel_parameters,
        np.empty(0) if projector is None else projector.kernel_parameters,
        0 if phase.axis == "u" else 1,
        [options.max_miss_px, options.projector_px, options.sigmas, *map(float, box[0]), *map(float, box[1])],
        [int(rejection_bit(reason)) for reason in ("unmatched", "masked", "mismatch")],
        threads,
    )
    # A pixel is 1 / f of the distance wide; a surface tilted by t changes its distance by tan t of that.
    pixel_size = 1 / float(min(own.K[0, 0], own.K[1, 1]))
    steepest = float(np.tan(np.radians(options.max_incidence_deg)))
    grazing = _core.grazing_points(
        depth, found.sigma_mm, phase.position_px, pixel_size, steepest, RIM_PX, options.rim_sigmas, threads
    )
    per_pixel = float(np.tan(np.radians(options.max_tilt_deg)) * pixel_size)
    small = _core.islands(depth, found.sigma_mm, grazing, per_pixel, options.sigmas, options.min_island_pixels, threads)
    for pixels, reason in ((grazing, "edge"), (small, "isolated")):
        rejected |= pixels * rejection_bit(reason)
    return rejected


def drop_points(found: TriangulatedPoints, pixel_px: Map | None, rejected: NDArray[np.uint16], threads: int) -> None:
    """Set points, standard deviations and corresponding pixels to NaN, in place, where `rejected` (H, W) is not 0."""
    for values in (found.points_sensor, found.sigma_mm, pixel_px):
        if values is not None:
            _core.drop_rejected(rejected, values, threads)
