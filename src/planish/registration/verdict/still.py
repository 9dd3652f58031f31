"""What stands still in the image belongs to the sensor, to a background, or to a part that was not moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Measurement
from planish.registration.matches import Matches
from planish.registration.result import Direction
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


def geometry_stands_still(directions: tuple[Direction, ...], still_mm: float) -> bool:
    """Return whether the surfaces alone, without texture, prove that nothing moved by `still_mm`.

    A sensor's own pattern agrees whatever the part did; but surfaces that hold every direction agree only where the
    part is. A plate holds three directions of six, whatever its texture.
    """
    if not directions:
        return False
    share = np.array([d.texture_share for d in directions])
    sigma = np.array([d.sigma_mm for d in directions])
    # The variance is inverse to the information; the surfaces have 1 - share of it. Three standard deviations.
    alone = sigma / np.sqrt(np.maximum(1 - share, 1e-12))
    return bool((3 * alone < still_mm).all())


def left_out(
    still: Hypothesis, moving: Hypothesis, shapes: tuple[tuple[int, int], tuple[int, int]], half_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the pixels (H, W) of a and of b that belong to what stood still, not to what moved.

    They are the windows (of half an edge `half_px`) that agree with standing still and not with the motion.
    """
    moved = np.isin(still.windows.cell, moving.windows.cell[moving.windows.agrees])
    own = still.windows.agrees & ~moved
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
