"""The same names for a board's points in both cameras, where the board looks the same after a turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from planish.geometry import Array
from planish.sensing.calibrate.boards.grid import fit_homography
from planish.sensing.calibrate.boards.label import renamed
from planish.sensing.calibrate.observations import BoardPoints, Index
from planish.sensing.calibrate.symmetry import names_alike
from planish.sensing.capture.board import Board, board_points

#: Rotations between the cameras that lie this near to each other agree [rad]: rough camera matrices tell no better.
AGREEMENT_RAD = np.deg2rad(10.0)
#: Proposals are tied where their misfits differ by less than this share of AGREEMENT_RAD per view.
TIED = 0.02


def agree(
    views: Sequence[Mapping[str, BoardPoints]],
    board: Board,
    size_px: Mapping[str, tuple[int, int]],
    known: Sequence[Array | None],
) -> list[Index]:
    """Return per view the turn of camera B's points (see `names_alike`) after which both cameras mean the same points.

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
    rotation from A to B, with rough camera matrices; the proposal that most views have a turn for is right. Where
    boards are all parallel, several agree: then the one with the cameras' x axes most alike.
    """
    permutations = names_alike(board)
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
