"""From the rough places of a board's points to sub-pixel ones, by fitting the figure around each to the grey values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.sensing.calibrate.figures import crossing, disc
from planish.sensing.calibrate.grid import grid_shape
from planish.sensing.calibrate.observations import Index
from planish.sensing.calibrate.window_fit import FigureFit, Windows, cut_windows, fit_figures
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Circles, board_points

#: A crossing's window reaches so many pixels at most, and this share of the way to the next edge.
CORNER_RADIUS_PX, CORNER_REACH = 12, 0.7
#: A disc's window reaches this share of the way to the next disc's centre.
DISC_REACH = 0.5
#: Windows smaller than this [px] hold no more than the blur of their edges.
MIN_RADIUS_PX = 3
#: Blur of a lens in focus, with a pixel's own width [px]: where the fit starts.
START_BLUR_PX = 0.9
#: A figure found further from its rough place than this share of the pitch is another one.
MAX_MOVE = 0.3
#: Residuals, as a share of the step between dark and light, of a figure that is what it should be: below the first, or
#: below so many times their median over the board; where a board's square ends, they are 0.15 and more.
FITTING, FITTING_TIMES = 0.05, 4.0
#: In no case above this: something else lies over the figure.
MAX_MISFIT = 0.3
#: A side goes on where so many of the places beyond it hold a figure, of at least half the contrast of the board's.
GOES_ON_SHARE, GOES_ON_CONTRAST = 0.6, 0.5
#: Systematic part of a point's error, added to that by noise: what print and pixels leave of the model (measured on
#: drawn boards, blur 0.3 to 1.5 px: 0.002) [px].
MODEL_PX = 0.002


@dataclass(frozen=True)
class Refined:
    """Sub-pixel places of points that were found.

    Parameters
    ----------
    index : ndarray (n,)
        Which points, as rows of `board_points`.
    pixel_px : ndarray (n, 2)
        Where they are [px].
    sigma_px : ndarray (n,)
        Standard deviation of a coordinate [px].
    dark : ndarray (n,) bool
        Whether the square to the right of a crossing and below it, as labelled, is the darker one; whether a disc is.
    contrast : ndarray (n,)
        Half the step between dark and light, and its sense [grey levels].
    limit : float
        Residuals, as a share of that step, up to which a figure was taken for one.
    """

    index: Index
    pixel_px: Array
    sigma_px: Array
    dark: NDArray[np.bool_]
    contrast: Array
    limit: float


def refine_points(image: NDArray[Any], board: Board, index: Index, rough_px: Array) -> Refined:
    """Return the sub-pixel places of the points `index` near their rough places (n, 2); those not found are left out.

    Parameters
    ----------
    image : ndarray (H, W)
        Grey values of any depth.
    board : Board
        What is printed.
    index : ndarray (n,) int
        Which points, as rows of `board_points`.
    rough_px : ndarray (n, 2)
        Where they are, to a tenth of the pitch [px].
    """
    grid = board_points(board)[:, :2] / board.pitches_mm
    grid = _grid(board)[index]
    slope, _ = grid_shape(grid, rough_px)
    fit = _first_fit(image, board, rough_px, slope)
    if not _is_of_discs(board):
        fit = _with_bent_edges(image, board, grid, rough_px, fit)
    misfit = fit.noise / (2 * np.abs(fit.contrast)).clip(1e-9)
    limit = min(MAX_MISFIT, max(FITTING, FITTING_TIMES * float(np.median(misfit))))
    variance = np.trace(fit.covariance_px2, axis1=1, axis2=2) / 2
    moved = np.linalg.norm(fit.center_px - rough_px, axis=1)
    good = np.isfinite(variance) & (misfit < limit) & (moved < MAX_MOVE * np.sqrt(np.abs(np.linalg.det(slope))))
    sigma = np.sqrt(variance[good] + MODEL_PX**2)
    dark = (fit.contrast[good] > 0) == _is_of_discs(board)
    return Refined(index[good], fit.center_px[good], sigma, dark, fit.contrast[good], limit)


def sides_that_go_on(image: NDArray[Any], board: Board, found: Refined) -> int:
    """Return on how many of its four sides the pattern goes on beyond the board's last points."""
    columns, rows = board.grid
    grid = _grid(board)
    pixel = np.full((len(grid), 2), np.nan)
    pixel[found.index] = found.pixel_px
    place = np.arange(len(grid)).reshape(rows, columns)
    # From row to row of an asymmetric grid the columns shift there and back: like follows like after two.
    step = 2 if isinstance(board, AsymmetricCircles) else 1
    outer, beyond = [], []
    for lines, by in ((place, step), (place[::-1], step), (place.T, 1), (place.T[::-1], 1)):
        if len(lines) > 2 * by:
            edge, inner, third = lines[0], lines[by], lines[2 * by]
            expected = 3 * pixel[edge] - 3 * pixel[inner] + pixel[third]
            known = np.isfinite(expected).all(1)
            outer.append((2 * grid[edge] - grid[inner])[known])
            beyond.append(expected[known])
    around = np.vstack([*outer, grid[found.index]])
    slope = grid_shape(around, np.vstack([*beyond, found.pixel_px]))[0][: -len(found.index)]
    fit = _first_fit(image, board, np.vstack(beyond), slope)
    misfit = fit.noise / (2 * np.abs(fit.contrast)).clip(1e-9)
    strong = np.abs(fit.contrast) > GOES_ON_CONTRAST * np.median(np.abs(found.contrast))
    sides = np.split(strong & (misfit < found.limit), np.cumsum([len(side) for side in outer])[:-1])
    return sum(len(side) > 1 and side.mean() >= GOES_ON_SHARE for side in sides)


def _grid(board: Board) -> Array:
    return board_points(board)[:, :2] / board.pitches_mm


def _is_of_discs(board: Board) -> bool:
    return isinstance(board, (Circles, AsymmetricCircles))


def _first_fit(image: NDArray[Any], board: Board, rough_px: Array, slope: Array) -> FigureFit:
    if _is_of_discs(board):
        windows, start = _disc_windows(image, board, rough_px, slope)
        return fit_figures(windows, disc, start)
    windows, start = _crossing_windows(image, board, rough_px, slope)
    return fit_figures(windows, crossing, start)


def _with_bent_edges(image: NDArray[Any], board: Board, grid: Array, rough_px: Array, first: FigureFit) -> FigureFit:
    """Return the crossings fitted with the curvature that the lens gives their edges: their neighbours tell."""
    known = np.asarray(np.isfinite(first.covariance_px2).all((1, 2)))
    center = np.where(known[:, None], first.center_px, rough_px)
    slope, bend = grid_shape(grid, center)
    windows, start = _crossing_windows(image, board, rough_px, slope)
    start[:, :2], start[:, 2:5] = center - windows.middle, first.form[:, :3]
    for k, along in ((2, 1), (3, 0)):
        normal = np.stack([np.cos(start[:, k]), np.sin(start[:, k])], -1)
        start[:, 3 + k] = (bend[:, :, along] * normal).sum(1) / (slope[:, :, along] ** 2).sum(1)
    return fit_figures(windows, crossing, start)


def _normal(edge: Array, towards: Array) -> Array:
    """Return directions (n,) [rad] at right angles to edges (n, 2), on the side of `towards` (n, 2)."""
    side = np.sign(-edge[:, 1] * towards[:, 0] + edge[:, 0] * towards[:, 1])
    return np.arctan2(side * edge[:, 0], -side * edge[:, 1])


def _crossing_windows(image: NDArray[Any], board: Board, rough_px: Array, slope: Array) -> tuple[Windows, Array]:
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


def _disc_windows(image: NDArray[Any], board: Board, rough_px: Array, slope: Array) -> tuple[Windows, Array]:
    """Return the windows around discs, and q to start with."""
    reach = DISC_REACH * (np.sqrt(2) if isinstance(board, AsymmetricCircles) else 1.0)
    radius = int(np.ceil(reach * np.linalg.norm(slope, ord=2, axis=(1, 2)).max()))
    windows = cut_windows(image, rough_px, max(radius, MIN_RADIUS_PX))
    distance = np.linalg.norm(_in_pitches(windows, rough_px, slope), axis=1)
    inside = windows.weight * (distance < reach)
    windows = Windows(windows.middle, windows.offset, windows.grey, inside)
    start = np.empty((len(rough_px), 6))
    start[:, :2] = rough_px - windows.middle
    for k in range(len(rough_px)):
        form = np.linalg.inv(slope[k]) / _disc_radius(windows.grey[k], inside[k] > 0, distance[k], reach)
        L = np.linalg.cholesky(form.T @ form).T
        start[k, 2:5] = L[0, 0], L[0, 1], L[1, 1]
    start[:, 5] = np.log(START_BLUR_PX)
    return windows, start


def _disc_radius(grey: Array, inside: NDArray[np.bool_], distance: Array, reach: float) -> float:
    """Return the radius [pitches] of the disc in the window by the share of its pixels that it covers."""
    values, middle = grey[inside], grey[inside & (distance < 0.25 * reach)]
    if not len(middle):
        return 0.5 * reach
    low, high = np.quantile(values, (0.05, 0.95))
    light = values > 0.5 * (low + high)
    share = float(np.mean(light == (np.median(middle) > 0.5 * (low + high))))
    return reach * float(np.sqrt(np.clip(share, 0.05, 0.9)))
