"""From the rough places of a board's points to sub-pixel ones, by fitting the figure around each to the grey values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.sensing.calibrate.boards.figure_windows import crossing_windows, disc_windows, per_length
from planish.sensing.calibrate.boards.figures import crossing, disc
from planish.sensing.calibrate.boards.grid import grid_shape
from planish.sensing.calibrate.boards.window_fit import FigureFit, fit_figures
from planish.sensing.calibrate.observations import Index
from planish.sensing.capture.board import AsymmetricCircles, Board, Circles, board_points

#: A figure found further from its rough place than this share of the pitch is another one.
MAX_MOVE = 0.3
#: Residuals, as a share of the step between dark and light, of a figure that is what it should be: below the first, or
#: below so many times their median over the board; where a board's square ends, they are 0.15 and more.
FITTING, FITTING_TIMES = 0.05, 4.0
#: In no case above this: something else lies over the figure.
MAX_MISFIT = 0.3
#: Discs of one board have radii that differ by less than this factor.
SAME_SIZE = 1.3
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
    radius : float or None
        Median radius of discs [smaller pitch].
    """

    index: Index
    pixel_px: Array
    sigma_px: Array
    dark: NDArray[np.bool_]
    contrast: Array
    limit: float
    radius: float | None


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
    grid = _grid(board)[index]
    slope, _ = grid_shape(grid, rough_px)
    fit = _first_fit(image, board, rough_px, slope)
    if _is_of_discs(board):
        # Now that their size is known: nothing beside the discs, such as the paper's end, gets into the windows.
        fit = _first_fit(image, board, rough_px, slope, float(np.median(_disc_radii(fit, board, slope))))
    else:
        fit = _with_bent_edges(image, board, grid, rough_px, fit)
    limit = min(MAX_MISFIT, max(FITTING, FITTING_TIMES * float(np.median(_misfit(fit)))))
    radius = float(np.median(_disc_radii(fit, board, slope))) if _is_of_discs(board) else None
    good = _is_figure(fit, board, rough_px, slope, limit, radius)
    sigma = np.sqrt(np.trace(fit.covariance_px2[good], axis1=1, axis2=2) / 2 + MODEL_PX**2)
    dark = (fit.contrast[good] > 0) == _is_of_discs(board)
    return Refined(index[good], fit.center_px[good], sigma, dark, fit.contrast[good], limit, radius)


def _misfit(fit: FigureFit) -> Array:
    """Return the residuals (n,) as a share of the step between dark and light."""
    return fit.noise / (2 * np.abs(fit.contrast)).clip(1e-9)


def _disc_radii(fit: FigureFit, board: Board, slope: Array) -> Array:
    """Return the discs' largest and smallest radii (n, 2) [smaller pitch]."""
    L = np.zeros((len(fit.form), 2, 2))
    L[:, 0, 0], L[:, 0, 1], L[:, 1, 1] = fit.form[:, :3].T
    return np.asarray(1 / np.linalg.svd(L @ per_length(board, slope), compute_uv=False).clip(1e-6)[:, ::-1])


def _is_figure(
    fit: FigureFit, board: Board, rough_px: Array, slope: Array, limit: float, radius: float | None
) -> NDArray[np.bool_]:
    """Return which fits (n,) found a figure where one should be, discs of about this radius [smaller pitch]."""
    moved = np.linalg.norm(fit.center_px - rough_px, axis=1)
    good = np.isfinite(fit.covariance_px2).all((1, 2)) & (_misfit(fit) < limit)
    good &= moved < MAX_MOVE * np.sqrt(np.abs(np.linalg.det(slope)))
    if radius is not None:
        good &= np.abs(np.log(_disc_radii(fit, board, slope) / radius)).max(1) < np.log(SAME_SIZE)
    return np.asarray(good)


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
    fit = _first_fit(image, board, np.vstack(beyond), slope, found.radius)
    contrast = np.median(np.abs(found.contrast))
    strong = np.abs(fit.contrast) > GOES_ON_CONTRAST * contrast
    if _is_of_discs(board):
        strong &= np.sign(fit.contrast) == np.sign(np.median(found.contrast))
    figure = _is_figure(fit, board, np.vstack(beyond), slope, found.limit, found.radius)
    sides = np.split(strong & figure, np.cumsum([len(side) for side in outer])[:-1])
    return sum(len(side) > 1 and side.mean() >= GOES_ON_SHARE for side in sides)


def _grid(board: Board) -> Array:
    return board_points(board)[:, :2] / board.pitches_mm


def _is_of_discs(board: Board) -> bool:
    return isinstance(board, (Circles, AsymmetricCircles))


def _first_fit(
    image: NDArray[Any], board: Board, rough_px: Array, slope: Array, radius: float | None = None
) -> FigureFit:
    if _is_of_discs(board):
        windows, start = disc_windows(image, board, rough_px, slope, radius)
        return fit_figures(windows, disc, start)
    windows, start = crossing_windows(image, board, rough_px, slope)
    return fit_figures(windows, crossing, start)


def _with_bent_edges(image: NDArray[Any], board: Board, grid: Array, rough_px: Array, first: FigureFit) -> FigureFit:
    """Return the crossings fitted with the curvature that the lens gives their edges: their neighbours tell."""
    known = np.asarray(np.isfinite(first.covariance_px2).all((1, 2)))
    center = np.where(known[:, None], first.center_px, rough_px)
    slope, bend = grid_shape(grid, center)
    windows, start = crossing_windows(image, board, rough_px, slope)
    start[:, :2], start[:, 2:5] = center - windows.middle, first.form[:, :3]
    for k, along in ((2, 1), (3, 0)):
        normal = np.stack([np.cos(start[:, k]), np.sin(start[:, k])], -1)
        start[:, 3 + k] = (bend[:, :, along] * normal).sum(1) / (slope[:, :, along] ** 2).sum(1)
    return fit_figures(windows, crossing, start)
