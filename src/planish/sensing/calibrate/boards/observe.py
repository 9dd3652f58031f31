"""From the files of a board run to what cameras and projector saw of the board: observe_boards()."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from planish.errors import InputError
from planish.geometry import Array
from planish.options import thread_count
from planish.sensing.calibrate.boards.agree import agree
from planish.sensing.calibrate.boards.decode import decode_code
from planish.sensing.calibrate.boards.detect import detect_board
from planish.sensing.calibrate.boards.explain import describe_board, what_would_fit
from planish.sensing.calibrate.boards.images import read_board_image, read_grey_values
from planish.sensing.calibrate.boards.label import renamed
from planish.sensing.calibrate.boards.manifest import BoardRun, ViewFiles, load_run
from planish.sensing.calibrate.observations import BoardObservations, BoardPoints, BoardView, CodedPoints
from planish.sensing.capture.board import Board
from planish.sensing.capture.manifest import Capture

#: (what is done, how much of it, of how much)
Progress = Callable[[str, int, int], None]


class _Seen(NamedTuple):
    """One camera's image of a view: name for messages, size, and the points or why there are none."""

    image: str
    size_px: tuple[int, int]
    points: BoardPoints | str


def observe_boards(
    path: Path,
    board: Path | Board | None = None,
    images_dir: Path | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> BoardObservations:
    """Return what cameras and projector saw of the board in all views of a run.

    Parameters
    ----------
    path : Path
        A `boards.json` or a folder (see `load_run`).
    board : Path, Board or None
        Board, or its file, instead of the one that the run names.
    images_dir : Path or None
        Folder that images' names are relative to; default the manifest's folder.
    threads : int or None
        Images worked on at a time; the result does not depend on it.
    progress : callable or None
        Called with the name of what has just been done, how much is done, and of how much.

    Raises
    ------
    InputError
        Where files are missing or unreadable, sizes differ, or no image shows the board.
    """
    threads = thread_count(threads)
    run = load_run(path, board, images_dir)
    images = [(view, camera) for view in run.views for camera in _cameras(view)]
    coded = [view for view in run.views if view.capture is not None and _coded_axes(view.capture) == ("u", "v")]
    done = _Count(len(images) + len(coded), progress)
    seen = _detect_all(run, images, threads, done)
    sizes = _sizes(run, images, seen)
    found = [_found(view, seen) for view in run.views]
    if not any(found):
        reasons = list(dict.fromkeys(str(item.points) for item in seen.values()))
        raise InputError(
            run.path,
            f"no board in any of {len(seen)} images ({'; '.join(reasons[:3])})",
            what_would_fit([partial(read_grey_values, *item) for item in images], run.board)
            or describe_board(run.board),
        )
    codes = []
    for view, points in zip(run.views, found, strict=True):
        codes.append(decode_code(view.capture, points, run.board, threads) if view in coded and view.capture else ())
        if view in coded:
            done.step(f"code of {view.name}")
    return _assemble(run, seen, sizes, found, codes)


class _Count:
    """Counts what is done, and says so."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self._total, self._done, self._progress = total, 0, progress

    def step(self, name: str) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(name, self._done, self._total)


def _cameras(view: ViewFiles) -> tuple[str, ...]:
    return tuple(view.images) if view.capture is None else view.capture.cameras


def _coded_axes(capture: Capture) -> tuple[str, ...]:
    """Return the projector axes that the capture's fringes or Gray bits encode."""
    found = {entry.axis for entry in capture.manifest.sequence if entry.role in ("phase", "gray")}
    return tuple(sorted(found))


def _found(view: ViewFiles, seen: dict[tuple[str, str], _Seen]) -> dict[str, BoardPoints]:
    points = {camera: seen[view.name, camera].points for camera in _cameras(view)}
    return {camera: item for camera, item in points.items() if not isinstance(item, str)}


def _detect_all(
    run: BoardRun, images: Sequence[tuple[ViewFiles, str]], threads: int, done: _Count
) -> dict[tuple[str, str], _Seen]:
    def work(view: ViewFiles, camera: str) -> _Seen:
        name, image, mask = read_board_image(view, camera)
        return _Seen(name, (image.shape[1], image.shape[0]), detect_board(image, run.board, mask))

    with ThreadPoolExecutor(threads) as pool:
        tasks = {pool.submit(work, view, camera): (view.name, camera) for view, camera in images}
        try:
            for task in as_completed(tasks):
                done.step(task.result().image)
        except BaseException:
            # An error or an interrupt must not wait for images that nobody will use.
            pool.shutdown(cancel_futures=True)
            raise
    return {key: task.result() for task, key in tasks.items()}


def _sizes(
    run: BoardRun, images: Sequence[tuple[ViewFiles, str]], seen: dict[tuple[str, str], _Seen]
) -> dict[str, tuple[int, int]]:
    """Return the size of each camera's images, which is one and the same."""
    first: dict[str, _Seen] = {}
    for view, camera in images:
        item = seen[view.name, camera]
        other = first.setdefault(camera, item)
        if item.size_px != other.size_px:
            raise InputError(
                f"{run.path}: {item.image}",
                f"is {item.size_px[0]} x {item.size_px[1]} px",
                f"{other.size_px[0]} x {other.size_px[1]} px, as {other.image}: a camera's images are of one size",
            )
    return {camera: first[camera].size_px for camera in sorted(first)}


def _assemble(
    run: BoardRun,
    seen: dict[tuple[str, str], _Seen],
    sizes: dict[str, tuple[int, int]],
    found: Sequence[dict[str, BoardPoints]],
    codes: Sequence[tuple[CodedPoints, ...]],
) -> BoardObservations:
    known = [_in_camera_b(points, code) for points, code in zip(found, codes, strict=True)]
    views = []
    for view, points, code, turn in zip(run.views, found, codes, agree(found, run.board, sizes, known), strict=True):
        if points:
            images = {camera: seen[view.name, camera].image for camera in points}
            turned = {camera: renamed(p, turn) if camera == "B" else p for camera, p in points.items()}
            places = tuple(renamed(c, turn) if c.camera == "B" else c for c in code)
            views.append(BoardView(view.name, turned, places, images))
    missed = {item.image: item.points for item in seen.values() if isinstance(item.points, str)}
    for view in run.views:
        axes = () if view.capture is None else _coded_axes(view.capture)
        if len(axes) == 1:
            missed[f"{view.name}: code"] = f"only the projector's axis {axes[0]} is encoded: u and v are needed"
    return BoardObservations(run.board, sizes, _projector_size(run), tuple(views), missed)


def _projector_size(run: BoardRun) -> tuple[int, int] | None:
    size: tuple[int, int] | None = None
    for view in run.views:
        if view.capture is None or _coded_axes(view.capture) != ("u", "v"):
            continue
        own = view.capture.manifest.projector_px
        if size is not None and own != size:
            raise InputError(view.capture.path, f"projector_px is {list(own or ())}", f"{list(size)} as in the others")
        size = own
    return size


def _in_camera_b(points: dict[str, BoardPoints], code: tuple[CodedPoints, ...]) -> Array | None:
    """Return where the projector's code puts the points of camera A in camera B [px], NaN where it does not say."""
    by_camera = {item.camera: item for item in code}
    if not {"A", "B"} <= by_camera.keys():
        return None
    a, b = by_camera["A"], by_camera["B"]
    nearest = np.linalg.norm(a.position_px[:, None] - b.position_px[None], axis=2).argmin(1)
    step = a.position_px - b.position_px[nearest]
    # The map around the nearest point, backwards: exact enough to tell a point from its neighbours.
    places = b.camera_px[nearest] + np.linalg.solve(b.jacobian[nearest], step[..., None])[..., 0]
    out = np.full((len(points["A"].index), 2), np.nan)
    out[np.searchsorted(points["A"].index, a.index)] = places
    return out
