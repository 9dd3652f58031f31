"""What stands still in the image belongs to the sensor, to a background, or to a part that was not moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Measurement
from planish.registration.matches import Matches
from planish.registration.refine.solve import Refined
from planish.registration.verdict.hypothesis import Hypothesis


def same_sensor(a: Measurement, b: Measurement) -> bool:
    """Return whether both were taken by the same camera, so that what is fixed to it stands at the same pixels."""
    return (
        a.organised_on == b.organised_on
        and a.shape == b.shape
        and np.array_equal(a.camera.kernel_parameters[:17], b.camera.kernel_parameters[:17])
    )


def standing_still(matches: Matches, still_px: float) -> NDArray[np.bool_]:
    """Return per match (M,) whether its pixel is the same in both images."""
    moved = np.linalg.norm(matches.pixels_a - matches.pixels_b, axis=1)
    return np.asarray(moved < still_px)


def geometry_stands_still(refined: Refined, still_mm: float) -> bool:
    """Return whether the surfaces alone, without texture, prove that nothing moved by `still_mm`.

    A sensor's own pattern agrees whatever the part did, and so do its own small errors of the surface; but where any
    motion by `still_mm` would part the surfaces by as much as the noise of a single pixel's distance (rms over the
    overlap), they agree only where the part is. That averages of many pixels see less does not count: errors of the
    sensor do not average.
    """
    e = refined.equations
    scale = np.array([refined.lever_mm] * 3 + [1.0] * 3)
    # Sum of the squared changes of distance by 1 mm at the rim, in units of the residuals' variance.
    H = e.H_distance_unbiased / np.outer(scale, scale)
    least = max(float(np.linalg.eigvalsh((H + H.T) / 2)[0]), 0.0) / max(e.points, 1)
    return bool(still_mm * np.sqrt(least) > 1)


def left_out(
    still: Hypothesis, moving: Hypothesis, shapes: tuple[tuple[int, int], tuple[int, int]], half_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the pixels (H, W) of a and of b that belong to what stood still, not to what moved.

    They are the windows (of half an edge `half_px`) that agree with standing still and not with the motion.
    """
    moved = np.isin(still.windows.cell, moving.windows.cell[moving.windows.agrees])
    own = still.windows.credible & ~moved
    return (
        _squares(still.windows.pixels_a[own], shapes[0], half_px),
        _squares(still.windows.found_b[own], shapes[1], half_px),
    )


def _squares(pixels: Array, shape: tuple[int, int], half_px: float) -> NDArray[np.bool_]:
    mask = np.zeros(shape, bool)
    for u, v in pixels[np.isfinite(pixels).all(1)]:
        rows = slice(max(0, round(v - half_px)), max(0, round(v + half_px) + 1))
        mask[rows, max(0, round(u - half_px)) : max(0, round(u + half_px) + 1)] = True
    return mask
