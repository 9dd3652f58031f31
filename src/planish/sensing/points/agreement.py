"""How far two ways to a point disagree beyond noise: projector and cameras, one projector axis and the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.measurement import Map
from planish.rig import Camera
from planish.sensing.decode import PhaseMap
from planish.sensing.points.triangulate import TriangulatedPoints

#: Pixels along the side of a block; every SAMPLE_STRIDE-th of them is looked at. Noise averages out in a block.
BLOCK, SAMPLE_STRIDE = 64, 8
#: Blocks with fewer samples, and captures with fewer blocks, tell nothing.
MIN_SAMPLES, MIN_BLOCKS = 32, 8
#: Bins of the phase: enough for the third harmonic of four steps.
PHASE_BINS = 48
#: Variance of a median over that of a mean, for normal noise (pi / 2).
MEDIAN_VARIANCE = np.pi / 2


@dataclass(frozen=True)
class Agreement:
    """Systematic part of the disagreement.

    Parameters
    ----------
    systematic_px : float or None
        Its root mean square over the image [projector px]; None where too few points are known.
    sigma_px : float or None
        Its standard deviation.
    """

    systematic_px: float | None
    sigma_px: float | None


def sample_pixels(shape: tuple[int, int]) -> NDArray[np.intp]:
    """Return the flat indices (h, w) of the pixels of an image (H, W) that are looked at."""
    rows, columns = (np.arange(0, n, SAMPLE_STRIDE) for n in shape)
    return rows[:, None] * shape[1] + columns


def measure_agreement(
    points_sensor: Map, projector: TriangulatedPoints, phase: PhaseMap, own: Camera, period_px: float | None
) -> Agreement:
    """Return how far the projector disagrees with the cameras beyond noise.

    Parameters
    ----------
    points_sensor : ndarray (h, w, 3)
        The sampled pixels' points from two cameras.
    projector : TriangulatedPoints
        Those from camera and projector (h, w).
    phase : PhaseMap
        The organising camera's positions, of the sampled pixels (h, w).
    own : Camera
        The organising camera.
    period_px : float or None
        Finest fringe period.

    Notes
    -----
    Both points lie on one ray; their distance becomes projector pixels by sigma_px / sigma_mm of the projector's.
    Noise is independent from pixel to pixel and vanishes in medians, of blocks of the image (what calibration and
    movement do) and, after that, of bins of the phase (what fringes that are no cosine do). The two noises share the
    own phase, so their sum would not tell the noise of the difference.
    """
    a, b = (_distance(points, own) for points in (points_sensor, projector.points_sensor))
    px = (b - a) * phase.sigma_px / projector.sigma_mm
    return _systematic(px, None if period_px is None else phase.position_px / np.float32(period_px))


def systematic_miss(miss_px: Map) -> Agreement:
    """Return how far the two projector axes disagree beyond noise, from the misses of the sampled pixels (h, w)."""
    return _systematic(miss_px, None)


def _systematic(px: NDArray[np.floating], periods: NDArray[np.floating] | None) -> Agreement:
    size = BLOCK // SAMPLE_STRIDE
    blocks = _blocks(px, size)
    counts = np.isfinite(blocks).sum(1)
    use = counts >= MIN_SAMPLES
    if use.sum() < MIN_BLOCKS:
        return Agreement(None, None)
    medians = np.full(len(blocks), np.nan)
    medians[use] = np.nanmedian(blocks[use], axis=1)
    rest = blocks - medians[:, None]
    spread = 1.4826 * np.nanmedian(np.abs(rest[use]))
    squares = medians[use] ** 2 - MEDIAN_VARIANCE * spread**2 / counts[use]
    total, total_sigma = float(np.mean(squares)), float(np.std(squares) / np.sqrt(use.sum()))
    if periods is not None:
        total = max(total, 0.0) + max(_ripple(rest, _blocks(periods, size), spread), 0.0)
    value = float(np.sqrt(max(total, 0.0)))
    # From the square to its root; near zero the root's own scatter is that of the square's root.
    return Agreement(value, total_sigma / (2 * max(value, np.sqrt(total_sigma))) if total_sigma > 0 else 0.0)


def _ripple(rest: NDArray[np.floating], periods: NDArray[np.floating], spread: float) -> float:
    known = np.isfinite(rest) & np.isfinite(periods)
    values, phases = rest[known], np.mod(periods[known], 1.0)
    bins = np.minimum((phases * PHASE_BINS).astype(int), PHASE_BINS - 1)
    order = np.argsort(bins, kind="stable")
    groups = np.split(values[order], np.searchsorted(bins[order], np.arange(1, PHASE_BINS)))
    squares = [np.median(g) ** 2 - MEDIAN_VARIANCE * spread**2 / len(g) for g in groups if len(g) >= MIN_SAMPLES]
    return float(np.mean(squares)) if squares else 0.0


def _blocks(image: NDArray[np.floating], size: int) -> NDArray[np.floating]:
    rows, columns = image.shape[0] // size, image.shape[1] // size
    cut = image[: rows * size, : columns * size].reshape(rows, size, columns, size)
    return cut.transpose(0, 2, 1, 3).reshape(rows * columns, size * size)


def _distance(points: Map, own: Camera) -> NDArray[np.floating]:
    return np.asarray(np.linalg.norm(points.astype(float) - own.center_sensor, axis=-1))
