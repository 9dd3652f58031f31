"""Which point of the board is which: boards that look the same after a turn, and orders that run the wrong way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from itertools import product
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.sensing.calibrate.observations import BoardPoints, CodedPoints, Index
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Chessboard, board_points

#: Turned by 90 degrees, points coincide to this share of the pitch.
SAME_PLACE = 1e-3
#: Rotations between the cameras that lie this near to each other agree [rad]: rough camera matrices tell no better.
AGREEMENT_RAD = np.deg2rad(10.0)
#: Proposals are tied where their misfits differ by less than this share of AGREEMENT_RAD per view.
TIED = 0.02

Points = TypeVar("Points", BoardPoints, CodedPoints)


def turns(board: Board) -> tuple[Index, ...]:
    """Return the turns of the board about its middle after which it looks the same, as permutations of its points.

    `turns(board)[k][i]` is the point that lies where point i lay. The first is no turn at all; pitches along x and y that
    differ by little do not make a board look different.
    """
    count = len(board_points(board))
    if isinstance(board, Charuco):
        return (np.arange(count),)
    grid = board_points(board)[:, :2] / board.pitches_mm
    middle = grid - grid.mean(0)
    found = []
    for quarter in range(4):
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        turned = middle @ np.array([[cos, sin], [-sin, cos]])
        distance = np.linalg.norm(turned[:, None] - middle[None], axis=2)
        to = distance.argmin(1)
        if distance.min(1).max() > SAME_PLACE or not _same_colours(board, to, quarter):
            continue
        found.append(to)
    return tuple(found)


def flipped_index(board: Board) -> Index | None:
    """Return the permutation of the board's points by a turn of 180 degrees, or None where it changes its looks."""
    half = np.arange(len(board_points(board)))[::-1]
    return next((turn for turn in turns(board) if np.array_equal(turn, half)), None)


def _same_colours(board: Board, turned: Index, quarter: int) -> bool:
    if not isinstance(board, Chessboard):
        return True
    # The square to the right of a crossing and below it is dark where column + row is even. A turn by 90 degrees brings
    # it to the side, where it is of the other colour.
    columns = board.grid[0]
    parity = lambda index: (index % columns + index // columns) % 2  # noqa: E731
    same = parity(turned) == parity(np.arange(len(turned)))
    return bool(same.all() if quarter % 2 == 0 else not same.any())


def order_of_points(board: Board, pixels: Array) -> Index | None:
    """Return which point of the board each of the pixels (N, 2) is, as found row by row from some corner of the grid.

    The board is seen from its front: where columns and rows run so that it would be seen from behind, the order is
    mirrored. Of the orders that remain the one with its columns most to the right in the image is taken. None where no
    order fits.
    """
    columns, rows = board.grid
    place = np.arange(columns * rows).reshape(rows, columns)
    orders = [place[::a, ::b] for a, b in product((1, -1), (1, -1))]
    if columns == rows:
        orders += [order.T for order in orders]
    if isinstance(board, AsymmetricCircles) and rows % 2 == 0:
        # OpenCV may take a grid that starts with the row that stands out, and exchange each two rows.
        orders += [order[np.arange(rows) ^ 1] for order in orders]
    points = board_points(board)[:, :2]
    best: tuple[float, Index] | None = None
    for order in orders:
        index = order.ravel()
        H = fit_homography(points[index], pixels)
        if H is None:
            continue
        middle = points.mean(0)
        J = homography_jacobian(H, middle[None])[0]
        error = np.median(np.linalg.norm(apply_homography(H, points[index]) - pixels, axis=1))
        if np.linalg.det(J) <= 0 or error > 0.3 * np.sqrt(abs(np.linalg.det(J)) * np.prod(board.pitches_mm)):
            continue
        to_right = J[0, 0] / np.hypot(*J[:, 0])
        if best is None or to_right > best[0]:
            best = (to_right, index)
    return None if best is None else best[1]


def matches_colours(board: Board, index: Index, dark: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which crossings (n,) have the colours that the board's print gives them; circles have none."""
    if not isinstance(board, (Chessboard, Charuco)):
        return np.ones(len(index), bool)
    columns, rows = board.grid
    first_dark = not (isinstance(board, Charuco) and board.legacy and (rows + 1) % 2 == 0)
    return np.asarray(((index % columns + index // columns) % 2 == 0) == (dark == first_dark))


def fit_homography(source: Array, target: Array) -> Array | None:
    """Return H (3, 3) that maps points (n, 2) to points (n, 2) in the least-squares sense, or None."""
    if len(source) < 4:
        return None
    H, _ = cv2.findHomography(source.reshape(-1, 1, 2), target.reshape(-1, 1, 2), 0)
    return None if H is None or not np.isfinite(H).all() else np.asarray(H, float)


def apply_homography(H: Array, points: Array) -> Array:
    """Return the points (n, 2) that H maps points (n, 2) to."""
    x = np.column_stack([points, np.ones(len(points))]) @ H.T
    return np.asarray(x[:, :2] / x[:, 2:])


def homography_jacobian(H: Array, points: Array) -> Array:
    """Return the derivative (n, 2, 2) of `apply_homography` at points (n, 2)."""
    x = np.column_stack([points, np.ones(len(points))]) @ H.T
    mapped = x[:, :2] / x[:, 2:]
    return np.asarray((H[None, :2, :2] - mapped[:, :, None] * H[None, 2:, :2]) / x[:, 2, None, None])


def agree(
    views: Sequence[Mapping[str, BoardPoints]],
    board: Board,
    size_px: Mapping[str, tuple[int, int]],
    known: Sequence[Array | None],
) -> list[Index]:
    """Return per view the turn of camera B's points (see `turns`) after which both cameras mean the same points.

    Parameters
    ----------
    views : sequence of mapping of BoardPoints
        Points per camera.
    board : Board
        What they are points of.
    size_px : mapping of tuple
        Per camera, (width, height).
    known : sequence of ndarray (n, 2) or None
        Per view, where other evidence (the projector's code) puts the points of camera A, in their order, in camera B
        [px], NaN where unknown.

    Notes
    -----
    A wrong turn puts the cameras to each other in a way that depends on the board's tilt. Each view and turn proposes a
    rotation from A to B, with rough camera matrices; the proposal that most views have a turn for is right. Where boards
    are all parallel, several agree: then the one with the cameras' x axes most alike.
    """
    permutations = turns(board)
    chosen = [permutations[0]] * len(views)
    both = [k for k, view in enumerate(views) if "A" in view and "B" in view]
    if len(permutations) == 1 or not both:
        return chosen
    focal = {name: rough_focal_px([v[name] for v in views if name in v], board, size_px[name]) for name in "AB"}
    open_views, proposals = [], []
    for k in both:
        a, b = views[k]["A"], views[k]["B"]
        turn = _by_evidence(a, b, known[k], permutations)
        if turn is not None:
            chosen[k] = turn
            continue
        R_A = _rotation(a, board, focal["A"], size_px["A"])
        R_B = [_rotation(renamed(b, turn), board, focal["B"], size_px["B"]) for turn in permutations]
        if R_A is not None and all(R is not None for R in R_B):
            open_views.append(k)
            proposals.append(np.stack([R @ R_A.T for R in R_B if R is not None]))
    if open_views:
        for k, number in zip(open_views, _consensus(np.stack(proposals)), strict=True):
            chosen[k] = permutations[number]
    return chosen


def _consensus(stacked: Array) -> Index:
    """Return which of the proposed rotations (views, turns, 3, 3) of each view agrees with those of the other views."""
    candidates = stacked.reshape(-1, 3, 3)
    angle = _angles(candidates[:, None, None], stacked[None])  # (candidates, views, turns)
    misfit = np.minimum(angle.min(2), AGREEMENT_RAD).sum(1)
    # Among rotations that agree alike (boards that are all parallel): the one that turns least about the line of sight.
    upright = np.abs(np.arctan2(candidates[:, 1, 0], candidates[:, 0, 0]))
    tied = misfit < misfit.min() + TIED * AGREEMENT_RAD * len(stacked)
    best = int(np.where(tied, upright, np.inf).argmin())
    return np.asarray(angle[best].argmin(1))


def renamed(points: Points, turn: Index) -> Points:
    """Return the points after a turn of the board (see `turns`), in the order of their new index."""
    index = turn[points.index]
    order = np.argsort(index)
    arrays = {f.name: getattr(points, f.name)[order] for f in fields(points) if f.name not in ("index", "camera")}
    return replace(points, index=index[order], **arrays)


def _by_evidence(a: BoardPoints, b: BoardPoints, known: Array | None, permutations: Sequence[Index]) -> Index | None:
    if known is None:
        return None
    errors = []
    for turn in permutations:
        _, in_a, in_b = np.intersect1d(a.index, turn[b.index], return_indices=True)
        distance = np.linalg.norm(known[in_a] - b.pixel_px[in_b], axis=1)
        errors.append(float(np.nanmedian(distance)) if np.isfinite(distance).any() else np.inf)
    return permutations[int(np.argmin(errors))] if np.isfinite(min(errors)) else None


def _angles(R: Array, S: Array) -> Array:
    """Return the angles [rad] between rotations (..., 3, 3)."""
    trace = np.einsum("...ij,...ij->...", R, S)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def rough_focal_px(seen: Sequence[BoardPoints], board: Board, size_px: tuple[int, int]) -> float:
    """Return a rough focal length [px] from the perspective of the boards in one camera, principal point in the middle.

    Notes
    -----
    Zhang, A flexible new technique for camera calibration, 2000, eq. 3 and 4 with K = diag(f, f, 1): two equations in
    1 / f^2 per board, solved together; 1.2 widths where the boards are too parallel to tell.
    """
    rows, rhs = [], []
    for points in seen:
        H = fit_homography(board_points(board)[points.index, :2], points.pixel_px - 0.5 * (np.array(size_px) - 1))
        if H is None:
            continue
        h, g = H[:, 0] / np.linalg.norm(H[:, 0]), H[:, 1] / np.linalg.norm(H[:, 0])
        rows += [h[0] * g[0] + h[1] * g[1], h[0] ** 2 + h[1] ** 2 - g[0] ** 2 - g[1] ** 2]
        rhs += [-h[2] * g[2], -(h[2] ** 2 - g[2] ** 2)]
    fallback, longest = 1.2 * max(size_px), float(max(size_px))
    a, b = np.array(rows), np.array(rhs)
    # a / f^2 = b, both sides in units of their rows: f^2 = a.a / a.b.
    if len(a) == 0 or not a @ b > 0:
        return fallback
    focal = float(np.sqrt((a @ a) / (a @ b)))
    return focal if 0.3 * longest < focal < 20 * longest else fallback


def _rotation(points: BoardPoints, board: Board, focal: float, size_px: tuple[int, int]) -> Array | None:
    """Return the rotation (3, 3) from the board's frame to the camera's, by the homography."""
    H = fit_homography(board_points(board)[points.index, :2], points.pixel_px - 0.5 * (np.array(size_px) - 1))
    if H is None:
        return None
    M = np.diag([1 / focal, 1 / focal, 1.0]) @ H
    M *= np.sign(M[2] @ [*board_points(board)[points.index, :2].mean(0), 1.0])
    r = M[:, :2] / np.sqrt(np.linalg.norm(M[:, 0]) * np.linalg.norm(M[:, 1]))
    U, _, Vt = np.linalg.svd(np.column_stack([r, np.cross(r[:, 0], r[:, 1])]))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
