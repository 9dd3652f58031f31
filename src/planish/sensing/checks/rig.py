"""Does the rig fit the images? The row error: how far across the epipolar line the same point really lies."""

from __future__ import annotations

import numpy as np

from planish import _core
from planish.measurement import Finding, Map
from planish.rig import Camera
from planish.sensing.checks.tiles import MIN_TILES, TILE_PX, TILES, RowError, Tiles
from planish.sensing.decode import PhaseMap, position_slope
from planish.sensing.points.triangulate import TriangulatedPoints

#: Every so many rows serve for the residual of the projector's ray.
RAY_ROWS = 32


def row_error_of_positions(tiles: Tiles, own: PhaseMap, other: PhaseMap) -> RowError:
    """Return the row error from the positions along the projector's second axis at corresponding pixels."""
    here = tiles.own(own.position_px)
    at, before, after = (tiles.other(other.position_px, shift) for shift in (0.0, -1.0, 1.0))
    slope = 0.5 * (after - before)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = ((here - at) / slope).reshape(len(here), -1)
        sigma = (tiles.own(own.sigma_px) / np.abs(slope)).reshape(len(here), -1)
    use = np.isfinite(error).mean(1) > 0.5
    error, sigma = error[use], sigma[use]
    count = np.isfinite(error).sum(1)
    # Both cameras' noise; neighbours share interpolated pixels, which one factor of two covers.
    deviation = 2 * np.nanmedian(sigma, 1) / np.sqrt(np.maximum(count, 1)) * np.sqrt(2) if len(error) else np.empty(0)
    return RowError(np.nanmedian(error, 1) if len(error) else np.empty(0), deviation, len(use))


def describe_row_error(error: RowError, source: str, other: str) -> Finding:
    """Return the row error as a finding."""
    quantity = f"row error of the rig in camera {other}"
    if not error.observable:
        told = f"{source}: {len(error.value_px)} of {error.searched} tiles show enough texture"
        return Finding(quantity, None, None, "px", told)
    source = f"{source}, {len(error.value_px)} tiles; varies by {error.spread_px:.2g} px over the image"
    warning = ""
    if error.bad:
        warning = (
            f"the rig does not fit the images: in camera {other} points lie {error.median_px:+.2f} +- "
            f"{error.sigma_median_px:.2f} px across the epipolar lines (+: towards larger rows), varying by "
            f"{error.spread_px:.2f} px over the image; calibrate again, or check that rig and images belong together"
        )
    return Finding(quantity, error.median_px, error.sigma_median_px, "px", source, warning)


def check_projector_ray(
    found: TriangulatedPoints, phase: PhaseMap, own: Camera, projector: Camera, threads: int
) -> Finding:
    """Return by how much the projector's own ray misses the points of the two cameras, in camera pixels."""
    rows = slice(RAY_ROWS // 2, None, RAY_ROWS)
    points, sigma_mm, position, position_sigma = (
        np.ascontiguousarray(a[rows]) for a in (found.points_sensor, found.sigma_mm, phase.position_px, phase.sigma_px)
    )
    residual, sigma = _core.projector_residual(
        projector.kernel_parameters,
        0 if phase.axis == "u" else 1,
        own.center_sensor,
        points,
        sigma_mm,
        position,
        position_sigma,
        threads,
    )
    per_pixel = max(position_slope(phase.position_px, 32), 1e-6)
    quantity = "miss of the projector's ray"
    # Tiles again: neighbours share the error of calibration, so that single pixels would feign certainty.
    values = [np.nanmedian(part) for part in _cells(residual) if np.isfinite(part).mean() > 0.5]
    if len(values) < MIN_TILES:
        return Finding(quantity, None, None, "px", "too few points")
    scatter = np.nanmedian(sigma) / per_pixel
    miss = RowError(
        np.array(values, float) / per_pixel, np.full(len(values), float(scatter) / np.sqrt(TILE_PX)), len(values)
    )
    warning = ""
    if miss.bad:
        warning = (
            f"the projector's ray misses the points of the two cameras by {miss.median_px:+.2f} +- "
            f"{miss.sigma_median_px:.2f} px, varying by {miss.spread_px:.2f} px over the image: the rig does not fit"
        )
    source = f"{len(values)} places; varies by {miss.spread_px:.2g} px over the image"
    return Finding(quantity, miss.median_px, miss.sigma_median_px, "px", source, warning)


def _cells(rows: Map) -> list[Map]:
    columns = np.array_split(np.arange(rows.shape[1]), TILES[0])
    lines = np.array_split(np.arange(rows.shape[0]), TILES[1])
    return [rows[line[0] : line[-1] + 1, column[0] : column[-1] + 1] for line in lines for column in columns
            if len(line) and len(column)]  # fmt: skip
