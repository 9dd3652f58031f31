"""Where the projector's code puts the board's points: a smooth map around each, from the pixels of one camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from planish.geometry import Array
from planish.sensing.calibrate.boards.grid import grid_shape
from planish.sensing.calibrate.observations import BoardPoints, CodedPoints
from planish.sensing.capture.board import Board, board_points
from planish.sensing.decode import PhaseMap
from planish.sensing.patterns.entries import Axis

#: The map is fitted to pixels so many pitches around the point along columns and rows. Larger windows smooth over what
#: paper that does not lie flat does between two points (seen on a real board: 0.1 px), smaller ones are noisier.
REACH = 0.5
#: Of larger windows every second, third ... row and column serves: neighbours say nearly the same.
MAX_PIXELS = 2500
#: Fewer pixels, or a smaller share of the window, fix no map of second order that is worth having.
MIN_PIXELS, MIN_SHARE = 30, 0.25
#: Residuals of more robust standard deviations are left out, in so many rounds.
OUTLIER_SIGMAS, ROUNDS = 4.0, 3
#: The window is cut into (columns, rows) of parts to see how alike neighbours' errors are, and so many terms of the map
#: that a turn by 180 degrees about the point leaves alone vary between them: 1, xx, xy, yy.
PARTS = (((6, 6), 4), ((12, 1), 2), ((1, 12), 2))


class _Map(NamedTuple):
    """One coordinate around one point: value, derivative (2,), variance of the value if neighbours were independent,
    and by how much the means of PARTS of the window vary more than that (3,).
    """

    value: float
    slope: Array
    variance: float
    alike: Array


def code_points(phases: Mapping[Axis, PhaseMap], points: BoardPoints, board: Board, camera: str) -> CodedPoints | None:
    """Return the projector positions of the points of the board that one camera saw.

    Parameters
    ----------
    phases : mapping of PhaseMap
        Position of each pixel along "u" and "v".
    points : BoardPoints
        Points in this camera.
    board : Board
        What they are points of.
    camera : str
        Name of the camera.

    Returns
    -------
    CodedPoints or None
        Of the points with enough decoded pixels around them on both axes; None where there are none.

    Notes
    -----
    A polynomial of second order around each point, least squares with the pixels' sigmas as weights. Errors of
    neighbouring pixels are alike (edges of a Gray code, surface texture): the variance of the polynomial's value is
    raised by what the means of blocks or strips of residuals scatter above independent ones, over all points.
    """
    grid = board_points(board)[points.index, :2] / board.pitches_mm
    slope, _ = grid_shape(grid, points.pixel_px)
    maps = {
        axis: [_local_map(phases[axis], pixel, steps) for pixel, steps in zip(points.pixel_px, slope, strict=True)]
        for axis in ("u", "v")
    }
    known = [k for k in range(len(points.index)) if maps["u"][k] is not None and maps["v"][k] is not None]
    if not known:
        return None
    found = {axis: [m for k in known if (m := maps[axis][k]) is not None] for axis in maps}
    variance = np.zeros(len(known))
    for axis in ("u", "v"):
        alike = max(1.0, float(np.mean([m.alike for m in found[axis]], 0).max()))
        variance += 0.5 * alike * np.array([m.variance for m in found[axis]])
    return CodedPoints(
        camera=camera,
        index=points.index[known],
        camera_px=points.pixel_px[known],
        position_px=np.array([[m.value for m in found[axis]] for axis in ("u", "v")]).T,
        jacobian=np.stack([[m.slope for m in found[axis]] for axis in ("u", "v")], 1),
        sigma_px=np.sqrt(variance),
    )


def _local_map(phase: PhaseMap, pixel: Array, steps: Array) -> _Map | None:
    """Return the map around one pixel (2,); `steps` (2, 2) are the steps to the next column and row of points [px]."""
    height, width = phase.shape
    reach = REACH * np.abs(steps).sum(1)
    low = np.maximum(np.ceil(pixel - reach), 0).astype(int)
    high = np.minimum(np.floor(pixel + reach), [width - 1, height - 1]).astype(int)
    every = max(1, int(np.sqrt(4 * REACH**2 * abs(np.linalg.det(steps)) / MAX_PIXELS)))
    u, v = np.meshgrid(np.arange(low[0], high[0] + 1, every), np.arange(low[1], high[1] + 1, every))
    offset = np.stack([u.ravel() - pixel[0], v.ravel() - pixel[1]])
    place = np.linalg.solve(steps, offset)
    inside = np.abs(place).max(0) < REACH
    position, sigma = (m[v.ravel(), u.ravel()].astype(float) for m in (phase.position_px, phase.sigma_px))
    use = inside & np.isfinite(position) & (sigma > 0)
    if use.sum() < max(MIN_PIXELS, MIN_SHARE * inside.sum()):
        return None
    x, y = place[:, use]
    A = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    weight, z = 1 / sigma[use], position[use]
    keep = np.ones(len(z), bool)
    for _ in range(ROUNDS):
        # A map that hangs on one side only, or on a line, says nothing about the point.
        if keep.sum() < MIN_PIXELS:
            return None
        weighted = A[keep] * weight[keep, None]
        inverse = np.linalg.pinv(weighted.T @ weighted, hermitian=True)
        coefficients = inverse @ (weighted.T @ (z[keep] * weight[keep]))
        residual = (z - A @ coefficients) * weight
        keep = np.abs(residual) <= OUTLIER_SIGMAS * 1.4826 * max(float(np.median(np.abs(residual))), 1e-9)
    scatter = float((residual[keep] ** 2).sum() / max(keep.sum() - A.shape[1], 1))
    alike = _alike(residual[keep], place[:, use][:, keep]) / max(scatter, 1e-30)
    return _Map(float(coefficients[0]), coefficients[1:3] @ np.linalg.inv(steps), scatter * float(inverse[0, 0]), alike)


def _alike(residual: Array, place: Array) -> Array:
    """Return the variance (3,) of parts' mean residuals times their numbers, that of one where all are independent.

    The parts are blocks, and strips along either side: an edge of a Gray code is off by the same along all its length.
    """
    out = []
    for (columns, rows), even_terms in PARTS:
        column, row = (
            np.floor((axis / (2 * REACH) + 0.5) * n).clip(0, n - 1).astype(int)
            for axis, n in zip(place, (columns, rows), strict=True)
        )
        part = row * columns + column
        # Light from the brighter squares pulls the pixels beside their edges towards them: on both sides of a crossing
        # in opposite directions. What a turn by 180 degrees turns round does not change the value in the middle.
        pair = np.minimum(part, columns * rows - 1 - part)
        count, total = np.bincount(pair), np.bincount(pair, residual)
        full = count > 0
        out.append(float((total[full] ** 2 / count[full]).sum() / max(full.sum() - even_terms, 1)))
    return np.array(out)
