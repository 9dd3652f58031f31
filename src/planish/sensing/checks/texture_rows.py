"""The row error from the textures of both cameras, correlated across the epipolar lines."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map, View
from planish.sensing.checks.tiles import TILE_PX, RowError, Tiles

#: Row errors are searched so far at once, and so far where nothing is found there [px].
NEAR_PX, FAR_PX = 2, 8
#: ... in fewer than this share of the tiles [1].
MOST_TILES = 0.75
#: Correlation of two tiles beyond what unrelated textures have, in standard deviations.
RELATED_SIGMAS = 5.0
#: Tiles whose row error is known less well do not count [px].
MAX_TILE_SIGMA_PX = 0.5
#: Shading, which both cameras see differently, is the mean over so many pixels; tiles lose such a margin by it.
SHADING_PX, MARGIN_PX = 9, 4
#: Pixels of a tile that are alike with their neighbours, per independent one.
ALIKE_PX = 4


def row_error_of_textures(tiles: Tiles, own: View, other: View) -> RowError:
    """Return the row error at which the textures of both cameras agree best.

    Notes
    -----
    C(j) = sum a b(j), a and b freed of slow shading: independent noise adds to C no bias. Its parabola through
    j - 1, j, j + 1 has its top at D / H, D = (C+ - C-) / 2, H = 2 C0 - C+ - C-; var(D) = r H + N r^2 / 8 with r the
    variance of what a and b do not share.
    """
    image_own, image_other = _texture(own), _texture(other)
    none = RowError(np.empty(0), np.empty(0), len(tiles.corner_px))
    if image_own is None or image_other is None:
        return none
    a = _flat(tiles.own(image_own))
    shifts = np.arange(-NEAR_PX, NEAR_PX + 1)
    scores = _scores(a, tiles, image_other, shifts)
    best, inside = _peaks(scores)
    if inside.mean() < MOST_TILES:
        shifts = np.arange(-FAR_PX, FAR_PX + 1)
        scores = _scores(a, tiles, image_other, shifts)
        best, inside = _peaks(scores)
    if not inside.any():
        return none
    near = Tiles(tiles.corner_px[inside], tiles.pixel_px[inside], tiles.across[inside])
    before, at, after = (scores[best[inside] + k, np.flatnonzero(inside)] for k in (-1, 0, 1))
    start = shifts[best[inside]] + 0.5 * (after - before) / np.maximum(2 * at - after - before, 1e-6)
    # Again from there: beside its top the parabola is exact.
    step, sigma = _top(a[inside], near, image_other, start)
    start = start + np.nan_to_num(step)
    use = np.isfinite(step) & (np.abs(step) < 1) & (sigma < MAX_TILE_SIGMA_PX)
    return RowError(start[use], sigma[use], len(inside)).smooth(near.corner_px[use])


def _peaks(scores: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the best shift of each tile, and whether it is a peak that stands out."""
    best = scores.argmax(0)
    return best, (best > 0) & (best < len(scores) - 1) & (scores.max(0) > RELATED_SIGMAS)


def _texture(view: View) -> Map | None:
    return view.mean if view.mean is not None else view.white


def _flat(tiles: Map) -> Map:
    """Return the inner part (n, pixels) of tiles relative to their local brightness; 0 where unknown."""
    known = np.isfinite(tiles)
    filled = np.where(known, tiles, 0)
    mean = filled.sum((1, 2), keepdims=True) / np.maximum(known.sum((1, 2), keepdims=True), 1)
    flat = np.where(known, filled / np.maximum(mean, np.float32(1e-3)) - 1, 0).astype(np.float32)
    # All tiles as one tall image: what the filter takes from the next tile lies in the margin.
    stack = flat.reshape(-1, TILE_PX)
    flat = (stack - cv2.blur(stack, (SHADING_PX, SHADING_PX))).reshape(flat.shape)
    inner = (slice(None), slice(MARGIN_PX, -MARGIN_PX), slice(MARGIN_PX, -MARGIN_PX))
    return np.ascontiguousarray((flat * known)[inner]).reshape(len(tiles), -1)


def _scores(a: Map, tiles: Tiles, image: Map, shifts: NDArray[np.int64]) -> Array:
    """Return the correlation (shifts, n) of tiles, in standard deviations of that of unrelated ones."""
    size = np.linalg.norm(a, axis=1)
    scores = []
    for shift in shifts:
        b = _flat(tiles.other(image, float(shift)))
        scores.append((a * b).sum(1) / np.maximum(size * np.linalg.norm(b, axis=1), 1e-12))
    return np.array(scores) * np.sqrt(a.shape[1] / ALIKE_PX)


def _top(a: Map, tiles: Tiles, image: Map, start: Array) -> tuple[Array, Array]:
    before, at, after = (_flat(tiles.other(image, start + shift)) for shift in (-1.0, 0.0, 1.0))
    c = [(a * b).sum(1).astype(float) for b in (before, at, after)]
    slope, bend = 0.5 * (c[2] - c[0]), 2 * c[1] - c[0] - c[2]
    gain = c[1] / np.maximum((at * at).sum(1), 1e-12)
    unlike = ((a - gain[:, None] * at) ** 2).mean(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt(unlike * bend + a.shape[1] * unlike**2 / 8) / bend
        return np.where(bend > 0, slope / bend, np.nan), np.where(bend > 0, sigma, np.inf)
