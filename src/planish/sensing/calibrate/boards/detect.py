"""The board in one image: its points to sub-pixel accuracy, or the reason why there are none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.geometry import Array
from planish.sensing.calibrate.boards.grid import NEIGHBOURS, polynomial
from planish.sensing.calibrate.boards.label import matches_colours, order_of_points
from planish.sensing.calibrate.boards.refine import Refined, refine_points, sides_that_go_on
from planish.sensing.calibrate.observations import BoardPoints, Index
from planish.sensing.calibrate.symmetry import names_alike
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Chessboard, Circles, board_points

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]

#: Boards are looked for in images of this length at most [px]; the points are refined in the full image.
SEARCH_PX = 1800
#: Fewer points of a board do not fix its place well enough to be worth keeping.
MIN_POINTS = 8
#: A point that falls out of a row of so many (least) is kept: more than this share must be found of a whole board.
MIN_SHARE = 0.5
#: An image whose brightest pixels stay below this share of the full scale is dark.
DARK_SHARE = 0.08
#: An image with more pixels at the full scale is saturated.
SATURATED_SHARE = 0.2


def detect_board(image: NDArray[Any], board: Board, mask: Mask | None = None) -> BoardPoints | str:
    """Return the board's points in an image, or why there are none.

    Parameters
    ----------
    image : ndarray (H, W)
        Grey values of any depth.
    board : Board
        What to look for.
    mask : ndarray (H, W) bool or None
        Where the image counts.

    Returns
    -------
    BoardPoints or str
        Points in the order of their index; or a reason in words.
    """
    rough = find_points(image, board)
    if rough is None:
        return _why_nothing(image)
    index, pixels = rough
    if len(index) < MIN_POINTS or _in_one_line(board, index):
        return f"only {len(index)} points of the board found"
    if isinstance(board, Charuco):
        index, pixels = _with_neighbours(board, index, pixels)
    fine = refine_points(image, board, index, pixels)
    if not isinstance(board, Charuco):
        size = f"{board.grid[0]} x {board.grid[1]}"
        if _lacks_a_side(board, fine.index):
            return f"a whole outer row or column of the {size} points is missing: is the board smaller?"
        if sides_that_go_on(image, board, fine):
            return f"the pattern goes on beyond {size} points: is the board larger?"
    coloured = _of_right_colour(fine, board, len(board_points(board)))
    if coloured is None:
        return "a pattern like the board's was found, but its squares have the wrong colours"
    fine = coloured
    if mask is not None:
        fine = _kept(fine, _inside(mask, fine.pixel_px))
    wanted = MIN_POINTS if isinstance(board, Charuco) else max(MIN_POINTS, MIN_SHARE * len(board_points(board)))
    if len(fine.index) < wanted or _in_one_line(board, fine.index):
        return f"only {len(fine.index)} points of the board can be located"
    order = np.argsort(fine.index)
    return BoardPoints(fine.index[order], fine.pixel_px[order], fine.sigma_px[order])


def find_points(image: NDArray[Any], board: Board) -> tuple[Index, Array] | None:
    """Return which points of the board are seen and roughly where (n, 2) [px], or None."""
    scale = min(1.0, SEARCH_PX / max(image.shape))
    grey = stretched(image)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if isinstance(board, Charuco):
        found = _find_charuco(grey, board, board.legacy)
    else:
        pixels = next(_find_grid(grey, board), None)
        index = None if pixels is None else order_of_points(board, pixels)
        found = None if pixels is None or index is None else (index, pixels)
    if found is None:
        return None
    # Pixel (0, 0) is the centre of the first pixel, before and after.
    factor = np.array(image.shape[::-1]) / grey.shape[::-1]
    return found[0], (found[1] + 0.5) * factor - 0.5


def stretched(image: NDArray[Any]) -> Image:
    """Return the image in 8 bit with its contrast stretched, for OpenCV's detectors."""
    low, high = np.quantile(image[::4, ::4], (0.002, 0.998))
    factor = 255.0 / max(float(high) - float(low), 1.0)
    return np.asarray(np.clip((image.astype(np.float32) - np.float32(low)) * np.float32(factor), 0, 255), np.uint8)


def _find_grid(grey: Image, board: Board) -> Iterator[Array]:
    """Yield the points (N, 2) row by row, from one end or the other, as often as a way of looking finds them."""
    if isinstance(board, Chessboard):
        for flags in (0, cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE):
            found, corners = cv2.findChessboardCornersSB(grey, board.corners, flags=flags)
            if found:
                yield np.asarray(corners, float).reshape(-1, 2)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(grey, board.corners, flags=flags)
        if found:
            yield np.asarray(corners, float).reshape(-1, 2)
        return
    assert isinstance(board, (Circles, AsymmetricCircles))
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if isinstance(board, AsymmetricCircles) else cv2.CALIB_CB_SYMMETRIC_GRID
    for clustering in (0, cv2.CALIB_CB_CLUSTERING):
        for light in (False, True):
            blobs = blob_detector(grey, len(board_points(board)), light)
            found, centers = cv2.findCirclesGrid(grey, board.circles, flags=kind | clustering, blobDetector=blobs)
            if found:
                yield np.asarray(centers, float).reshape(-1, 2)


def blob_detector(grey: Image, count: int, light: bool) -> Any:
    """Return a detector of dark or light discs, of which `count` have room in the image."""
    parameters: Any = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    # A disc cannot be larger than its share of the image; below 4 px across it has no centre worth measuring.
    parameters.maxArea = float(grey.size) / count
    parameters.minArea = 12.0
    parameters.minDistBetweenBlobs = 4.0
    parameters.blobColor = 255 if light else 0
    parameters.minCircularity, parameters.filterByCircularity = 0.6, True
    parameters.minInertiaRatio, parameters.filterByInertia = 0.1, True
    parameters.minConvexity, parameters.filterByConvexity = 0.85, True
    return cv2.SimpleBlobDetector_create(parameters)  # type: ignore[attr-defined]


def dictionaries() -> list[str]:
    """Return the names of OpenCV's dictionaries, without "DICT_"."""
    return sorted(name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_") and name.isupper())


def charuco_board(board: Charuco, legacy: bool) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's object of the board.

    Raises
    ------
    InputError
        Where OpenCV knows no such dictionary, or the markers do not fit.
    """
    code = getattr(cv2.aruco, f"DICT_{board.dictionary.upper()}", None)
    if code is None:
        raise InputError("board: dictionary", f"'{board.dictionary}'", f"one of {', '.join(dictionaries())}")
    pitch, dictionary = min(board.pitches_mm), cv2.aruco.getPredefinedDictionary(code)
    needed, held = board.squares[0] * board.squares[1] // 2, len(dictionary.bytesList)
    if board.marker_mm >= pitch:
        raise InputError("board: marker_mm", f"{board.marker_mm:g}", f"less than pitch_mm, {pitch:g}")
    if needed > held:
        raise InputError("board: dictionary", f"'{board.dictionary}' has {held} markers", f"{needed} for this board")
    made = cv2.aruco.CharucoBoard(board.squares, float(pitch), float(board.marker_mm), dictionary)
    made.setLegacyPattern(legacy)
    return made


def _find_charuco(grey: Image, board: Charuco, legacy: bool) -> tuple[Index, Array] | None:
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(board, legacy)).detectBoard(grey)
    if ids is None or len(ids) == 0:
        return None
    return np.asarray(ids, np.intp).ravel(), np.asarray(corners, float).reshape(-1, 2)


def _with_neighbours(board: Charuco, index: Index, pixels: Array) -> tuple[Index, Array]:
    """Return the points with those beside them where they should be: OpenCV finds only corners between two markers."""
    grid = board_points(board)[:, :2] / board.pitches_mm
    missing, places = [], []
    for k in np.setdiff1d(np.arange(len(grid)), index):
        near = np.abs(grid[index] - grid[k]).max(1) < NEIGHBOURS
        place = polynomial(grid[index][near] - grid[k], pixels[near], 1)
        if place is not None:
            missing.append(k)
            places.append(place[0])
    return np.append(index, np.array(missing, np.intp)), np.vstack([pixels, *places])


def _of_right_colour(fine: Refined, board: Board, count: int) -> Refined | None:
    """Return the points whose colours are those of the board, turned if it must be; None where no turn helps."""
    if not isinstance(board, (Chessboard, Charuco)):
        return fine
    right = matches_colours(board, fine.index, fine.dark)
    if isinstance(board, Charuco) or len(names_alike(board)) > 1:
        # Nothing tells apart: which colour comes first is the print's affair, but they must alternate.
        alternate = right if right.mean() >= 0.5 else ~right
        alternate = right if isinstance(board, Charuco) else alternate
        return _kept(fine, alternate) if alternate.mean() > 0.5 else None
    if right.mean() < 0.5:
        fine, right = replace(fine, index=count - 1 - fine.index), ~right
    return _kept(fine, right)


def _kept(fine: Refined, keep: Mask) -> Refined:
    arrays = {f.name: getattr(fine, f.name)[keep] for f in fields(fine) if f.name not in ("limit", "radius")}
    return replace(fine, **arrays)


def _inside(mask: Mask, pixels: Array) -> Mask:
    u, v = np.round(pixels).astype(int).T
    known = (u >= 0) & (v >= 0) & (u < mask.shape[1]) & (v < mask.shape[0])
    return known & mask[v.clip(0, mask.shape[0] - 1), u.clip(0, mask.shape[1] - 1)]


def _lacks_a_side(board: Board, index: Index) -> bool:
    """Whether no point of an outer row or column is left: OpenCV makes up what it expects."""
    columns, rows = board.grid
    seen = np.zeros((rows, columns), bool)
    seen.ravel()[index] = True
    return not (seen[0].any() and seen[-1].any() and seen[:, 0].any() and seen[:, -1].any())


def _in_one_line(board: Board, index: Index) -> bool:
    grid = board_points(board)[index, :2] / board.pitches_mm
    return bool(np.linalg.matrix_rank(grid - grid.mean(0), tol=1e-6) < 2) if len(grid) else True


def _why_nothing(image: NDArray[Any]) -> str:
    """Return in words why an image shows no board."""
    full = 255.0 if image.dtype == np.uint8 else max(4095.0, 2.0 ** np.ceil(np.log2(float(image.max()) + 1)) - 1)
    brightest, saturated = float(np.quantile(image[::4, ::4], 0.995)), float(np.mean(image >= full))
    if brightest < DARK_SHARE * full:
        return f"no board found: too dark (99.5 % of the pixels below {brightest:.0f} of {full:.0f})"
    if saturated > SATURATED_SHARE:
        return f"no board found: saturated ({100 * saturated:.0f} % of the pixels at {full:.0f})"
    return "no board found"
