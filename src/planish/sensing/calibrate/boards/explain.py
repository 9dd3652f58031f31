"""Why no image shows the board that was stated: which other board would fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.sensing.calibrate.boards.detect import blob_detector, detect_board, dictionaries, find_points, stretched
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Chessboard, Circles

#: So many images are looked at, spread over the run, at this length at most [px].
IMAGES, SEARCH_PX = 4, 1000
#: The smallest board that is looked for, and the most points along one side.
LEAST, MOST = 3, 40
#: Of a dictionary that fits, an image shows so many markers at least.
MIN_MARKERS = 4


def describe_board(board: Board) -> str:
    """Return in words what should have been seen."""
    size = f"{board.grid[0]} x {board.grid[1]}"
    if isinstance(board, Charuco):
        return (
            f"a ChArUco board of {board.squares[0]} x {board.squares[1]} squares with markers of {board.dictionary}"
            f"{', legacy layout' if board.legacy else ''}"
        )
    if isinstance(board, Chessboard):
        return f"a whole chessboard of {size} inner corners"
    return f"a whole {'asymmetric ' if isinstance(board, AsymmetricCircles) else ''}grid of {size} discs"


def what_would_fit(images: Sequence[Callable[[], NDArray[Any]]], board: Board) -> str:
    """Return in words which board some image shows instead of the stated one, or nothing."""
    for k in sorted({round(k) for k in np.linspace(0, len(images) - 1, IMAGES)}):
        grey = stretched(images[k]())
        scale = min(1.0, SEARCH_PX / max(grey.shape))
        if scale < 1:
            grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        for other in _others(grey, board):
            if other is not None:
                return f"{describe_board(board)}; {describe_board(other)} would fit"
    return ""


def _others(grey: NDArray[np.uint8], board: Board) -> Iterator[Board | None]:
    if isinstance(board, Charuco):
        yield _other_charuco(grey, board)
    looks = (_circles, _chessboard) if isinstance(board, (Circles, AsymmetricCircles)) else (_chessboard, _circles)
    for look in looks:
        yield look(grey, board)


def _printed(board: Board) -> dict[str, object]:
    return {"schema": "planish.board/1", "pitch_mm": board.pitch_mm}


def _chessboard(grey: NDArray[np.uint8], board: Board) -> Board | None:
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (LEAST, LEAST), flags)
    if not found or meta is None:
        return None
    columns, rows = _turned_like(board, *meta.shape[:2])
    other = Chessboard.model_validate({**_printed(board), "kind": "chessboard", "corners": (columns, rows)})
    # OpenCV sees chessboards in grids of circles too: only one whose crossings are crossings counts.
    return None if isinstance(detect_board(grey, other), str) else other


def _turned_like(board: Board, a: int, b: int) -> tuple[int, int]:
    """Return two numbers of points as (columns, rows) with the larger number where the stated board has it."""
    return (max(a, b), min(a, b)) if board.grid[0] >= board.grid[1] else (min(a, b), max(a, b))


def _circles(grey: NDArray[np.uint8], board: Board) -> Board | None:
    for light in (False, True):
        count = len(blob_detector(grey, 4, light).detect(grey))
        sizes = [(n, count // n) for n in range(LEAST, MOST) if count >= LEAST**2 and count % n == 0]
        for size in sorted(sizes, key=lambda size: abs(size[0] - size[1])):
            if min(size) < LEAST:
                continue
            columns, rows = _turned_like(board, *size)
            for kind, name in ((Circles, "circles"), (AsymmetricCircles, "asymmetric_circles")):
                other = kind.model_validate({**_printed(board), "kind": name, "circles": (columns, rows)})
                if not isinstance(detect_board(grey, other), str):
                    return other
    return None


def _other_charuco(grey: NDArray[np.uint8], board: Charuco) -> Board | None:
    """Return the board with another layout, dictionary or size under which markers and corners agree."""
    for name in dictionaries_seen(grey, board.dictionary):
        for legacy in (board.legacy, not board.legacy):
            for squares in (board.squares, board.squares[::-1]):
                other = board.model_copy(update={"dictionary": name, "legacy": legacy, "squares": squares})
                found = None if other == board else find_points(grey, other)
                if found is not None and len(found[0]) >= MIN_MARKERS:
                    return other
    return None


def dictionaries_seen(grey: NDArray[np.uint8], first: str) -> list[str]:
    """Return the dictionaries of which the image shows markers, the stated one first, the others by their number."""
    counts: dict[str, int] = {}
    for name in dict.fromkeys([first.upper(), *dictionaries()]):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
        _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
        counts[name] = 0 if ids is None else len(ids)
    seen = [name for name, count in counts.items() if count >= MIN_MARKERS]
    # Of a family the larger ones hold the smaller: the smallest that holds all markers is the likeliest.
    return sorted(seen, key=lambda name: (name != first.upper(), -counts[name], len(name), name))
