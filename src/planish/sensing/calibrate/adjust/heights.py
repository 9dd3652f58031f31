"""Heights of the board's points out of their plane, as modes of the adjustment: a polynomial, or each on its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planish.geometry import Array
from planish.measurement import Finding
from planish.sensing.calibrate.adjust.left_out import leave_out
from planish.sensing.calibrate.adjust.problem import Problem
from planish.sensing.calibrate.adjust.robust import Adjusted, outlier_limit
from planish.sensing.calibrate.adjust.stages import Started, adjust_chosen
from planish.sensing.capture.board import Board

#: Orders of the polynomials that stand for the heights of the board.
LEAST_ORDER, MOST_ORDER = 2, 4
#: Share of the largest singular value below which a polynomial is none of its own on this grid.
RANK_SHARE = 1e-6
#: A point's own height needs this many images that show it.
LEAST_IMAGES = 3
#: A point that is an outlier in this share of its images, and in two at least, does not lie where the board file says.
MOSTLY = 0.5
#: Points that are named.
NAMED = 8


def with_heights(problem: Problem) -> Problem:
    """Return the problem whose board may be uneven."""
    return replace(problem, modes=height_modes(problem.points_board))


def height_modes(points_board: Array) -> Array:
    """Return heights (k, N, 3) out of the plane: polynomials of order 2 to 4, orthogonal to each other and to planes.

    Each has an rms of 1 mm over the points; positive towards the sensor (the board's z points away from it).
    """
    x, y = _normalised(points_board).T
    powers = [(i, n - i) for n in range(MOST_ORDER + 1) for i in range(n, -1, -1)]
    Q = np.empty((len(x), 0))
    planes = 0
    for i, j in powers:
        column = x**i * y**j
        rest = column - Q @ (Q.T @ column)
        rest -= Q @ (Q.T @ rest)
        if np.linalg.norm(rest) > RANK_SHARE * np.linalg.norm(column):
            Q = np.column_stack([Q, rest / np.linalg.norm(rest)])
            planes += i + j < LEAST_ORDER
    return _modes(Q[:, planes:])


def point_modes(points_board: Array) -> Array:
    """Return heights (N - 3, N, 3) that are free at each point: all that is orthogonal to planes, scaled alike."""
    x, y = _normalised(points_board).T
    planes = np.linalg.qr(np.column_stack([np.ones(len(x)), x, y]))[0]
    # Columns of a projector onto what is no plane, made orthogonal: of rank N - 3.
    U, _, _ = np.linalg.svd(np.eye(len(x)) - planes @ planes.T)
    return _modes(U[:, : len(x) - 3])


def choose_heights(now: Started, item: Adjusted, share: float) -> tuple[Adjusted, Finding]:
    """Return the adjustment with each point's own height, if views left out agree with it better than with `item`.

    Parameters
    ----------
    now : Started
        Devices, places and lens models.
    item : Adjusted
        The adjustment with a polynomial for the heights.
    share : float
        Probability that observations without outliers lose any.
    """
    quantity = "heights of the board's points"
    images = sum(block.seen.sum(0) for block in item.problem.blocks)
    if images[images > 0].min() < LEAST_IMAGES or not images.all():
        told = f"polynomial of order {MOST_ORDER}: some points are in fewer than {LEAST_IMAGES} images"
        return item, Finding(quantity, None, None, "mm", told)
    problem = replace(now.problem, modes=point_modes(now.problem.points_board))
    free = adjust_chosen(replace(now, problem=problem), share)
    scores = _score(item, item, share), _score(free, item, share)
    own = scores[1] < scores[0]
    chosen = free if own else item
    heights = np.tensordot(chosen.state.amplitudes, chosen.problem.modes, 1)[:, 2]
    source = (
        f"rms over the points; {'each point on its own' if own else f'polynomial of order {MOST_ORDER}'}: views left "
        f"out fit within {np.sqrt(min(scores)):.2f} standard deviations, with the other kind {np.sqrt(max(scores)):.2f}"
    )
    return chosen, Finding(quantity, float(np.sqrt((heights**2).mean())), None, "mm", source)


def misplaced_points(item: Adjusted, board: Board) -> Finding:
    """Return which points of the board are outliers wherever they are seen: it is not flat or not printed so there."""
    seen = sum(block.seen.sum(0) for block in item.problem.blocks)
    out = sum(outlier.sum(0) for outlier in item.outlier)
    bad = np.flatnonzero((out >= 2) & (out > MOSTLY * seen))
    quantity = "points of the board that are outliers in most of their images"
    source = f"of {int((seen > 0).sum())} points"
    if not len(bad):
        return Finding(quantity, 0.0, None, "", source)
    columns = board.grid[0]
    names = ", ".join(f"({k % columns}, {k // columns})" for k in bad[:NAMED])
    more = f" and {len(bad) - NAMED} more" if len(bad) > NAMED else ""
    remedy = (
        "measure the board, or use another one"
        if item.free.modes
        else "ask for its flatness to be estimated, or use another one"
    )
    told = (
        f"points (column, row) {names}{more} of the board are left out in most images that show them: it is not flat "
        f"there, or covered; {remedy}"
    )
    return Finding(quantity, float(len(bad)), None, "", source, told)


def _score(item: Adjusted, scale: Adjusted, share: float) -> float:
    """Mean square of left-out residuals over the noise of `scale`; outliers count as much as the limit lets pass."""
    found = leave_out(item)
    points = sum(int(block.seen.sum()) for block in item.problem.blocks)
    limit2 = outlier_limit(points, share) ** 2
    total, count = 0.0, 0
    for block, outlier in zip(item.problem.blocks, item.outlier, strict=True):
        total += limit2 * float(outlier.sum())
        count += int(block.seen.sum())
    for device in item.problem.devices:
        sigma = np.concatenate([block.sigma_px[block.seen] for block in item.problem.blocks_of(device)])
        total += float(found.squares[device].sum() / (scale.noise[device] ** 2 * (sigma**2).mean()))
    return total / max(count, 1)


def _modes(Q: Array) -> Array:
    modes = np.zeros((Q.shape[1], len(Q), 3))
    modes[..., 2] = -np.sqrt(len(Q)) * Q.T
    return modes


def _normalised(points_board: Array) -> Array:
    centered = points_board[:, :2] - points_board[:, :2].mean(0)
    return np.asarray(centered / np.abs(centered).max(0))
