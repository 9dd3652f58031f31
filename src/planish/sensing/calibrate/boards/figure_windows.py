"""The windows around a board's points in which its figures are fitted, and where the fit starts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.sensing.calibrate.boards.window_fit import Windows, cut_windows
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco

#: A crossing's window reaches so many pixels at most, and this share of the way to the next edge.
CORNER_RADIUS_PX, CORNER_REACH = 12, 0.7
#: A disc's window reaches this share of the way to the next disc's centre.
DISC_REACH = 0.5
#: Of a disc of known size, the window reaches so many times its radius, and at least so far beyond it [px].
DISC_MARGIN, DISC_MARGIN_PX = 1.3, 3.0
#: Windows smaller than this [px] hold no more than the blur of their edges.
MIN_RADIUS_PX = 3
#: Blur of a lens in focus, with a pixel's own width [px]: where the fit starts.
START_BLUR_PX = 0.9


def per_length(board: Board, slope: Array) -> Array:
    """Return the steps (n, 2, 2) [px] of one length, the smaller pitch, along columns and rows: discs are round."""
    return np.asarray(slope * (min(board.pitches_mm) / np.array(board.pitches_mm)))


def crossing_windows(image: NDArray[Any], board: Board, rough_px: Array, slope: Array) -> tuple[Windows, Array]:
    """Return the windows around crossings, and q to start with."""
    reach = CORNER_REACH * np.linalg.norm(slope, axis=1).max()
    windows = cut_windows(image, rough_px, int(np.clip(reach, MIN_RADIUS_PX, CORNER_RADIUS_PX)))
    place = _in_pitches(windows, rough_px, slope)
    distance = np.hypot(*windows.offset)
    inside = (np.abs(place).max(1) < CORNER_REACH) & (distance <= max(CORNER_RADIUS_PX, MIN_RADIUS_PX))
    if isinstance(board, Charuco):
        # Between markers and edges there is a margin: only what lies beside an edge is part of the crossing.
        margin_px = 0.5 * (1 - board.marker_mm / max(board.pitches_mm)) * np.linalg.norm(slope, axis=1).min(1)
        edge_px = np.abs(place) * np.linalg.norm(slope, axis=1)[:, :, None]
        inside &= edge_px.min(1) < np.maximum(margin_px - 1.5, 1.5)[:, None]
    start = np.zeros((len(rough_px), 7))
    start[:, :2] = rough_px - windows.middle
    # Normals: of the edge between columns towards the next column, of that between rows towards the next row.
    start[:, 2] = _normal(slope[:, :, 1], slope[:, :, 0])
    start[:, 3] = _normal(slope[:, :, 0], slope[:, :, 1])
    start[:, 4] = np.log(START_BLUR_PX)
    return Windows(windows.middle, windows.offset, windows.grey, windows.weight * inside), start


def _in_pitches(windows: Windows, points_px: Array, slope: Array) -> Array:
    """Return the places (n, 2, m) of the windows' pixels in pitches along columns and rows, from the points (n, 2)."""
    offset = windows.offset[None] + (windows.middle - points_px)[:, :, None]
    return np.asarray(np.linalg.solve(slope, offset))


def disc_windows(
    image: NDArray[Any], board: Board, rough_px: Array, slope: Array, known: float | None
) -> tuple[Windows, Array]:
    """Return the windows around discs, and q to start with; `known` is the discs' radius [smaller pitch], if it is."""
    slope = per_length(board, slope)
    reach = np.full(len(rough_px), DISC_REACH * (np.sqrt(2) if isinstance(board, AsymmetricCircles) else 1.0))
    if known is not None:
        pitch_px = np.sqrt(np.abs(np.linalg.det(slope)))
        reach = np.minimum(reach, np.maximum(DISC_MARGIN * known, known + DISC_MARGIN_PX / pitch_px))
    size = int(np.ceil((reach * np.linalg.norm(slope, ord=2, axis=(1, 2))).max()))
    windows = cut_windows(image, rough_px, max(size, MIN_RADIUS_PX))
    distance = np.linalg.norm(_in_pitches(windows, rough_px, slope), axis=1)
    inside = windows.weight * (distance < reach[:, None])
    windows = Windows(windows.middle, windows.offset, windows.grey, inside)
    start = np.empty((len(rough_px), 6))
    start[:, :2] = rough_px - windows.middle
    for k in range(len(rough_px)):
        own = _disc_radius(windows.grey[k], inside[k] > 0, distance[k], float(reach[k])) if known is None else known
        form = np.linalg.inv(slope[k]) / own
        L = np.linalg.cholesky(form.T @ form).T
        start[k, 2:5] = L[0, 0], L[0, 1], L[1, 1]
    start[:, 5] = np.log(START_BLUR_PX)
    return windows, start


def _disc_radius(grey: Array, inside: NDArray[np.bool_], distance: Array, reach: float) -> float:
    """Return the radius [smaller pitch] of the disc in the window by the share of its pixels that it covers."""
    values, middle = grey[inside], grey[inside & (distance < 0.25 * reach)]
    if not len(middle):
        return 0.5 * reach
    low, high = np.quantile(values, (0.05, 0.95))
    light = values > 0.5 * (low + high)
    share = float(np.mean(light == (np.median(middle) > 0.5 * (low + high))))
    return reach * float(np.sqrt(np.clip(share, 0.05, 0.9)))


def _normal(edge: Array, towards: Array) -> Array:
    """Return directions (n,) [rad] at right angles to edges (n, 2), on the side of `towards` (n, 2)."""
    side = np.sign(-edge[:, 1] * towards[:, 0] + edge[:, 0] * towards[:, 1])
    return np.arctan2(side * edge[:, 0], -side * edge[:, 1])
