"""From the files of a board run to what cameras and projector saw of the board: observe_boards()."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.geometry import Array
from planish.options import thread_count
from planish.sensing.calibrate.code import code_points
from planish.sensing.calibrate.detect import detect_board
from planish.sensing.calibrate.explain import describe_board, what_would_fit
from planish.sensing.calibrate.label import agree, renamed
from planish.sensing.calibrate.manifest import BoardRun, ViewFiles, load_run
from planish.sensing.calibrate.observations import BoardObservations, BoardPoints, BoardView, CodedPoints
from planish.sensing.capture.board import Board
from planish.sensing.capture.images import read_grey
from planish.sensing.capture.manifest import Capture, ImageReader
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.checks.slips import observe_consistent
from planish.sensing.decode import DecodeOptions
from planish.sensing.exposures import merge_exposures, split_exposures
from planish.sensing.observe import Observation
from planish.sensing.waveform.straighten import straighten

#: (what is done, how much of it, of how much)
Progress = Callable[[str, int, int], None]

#: Of several exposures the longest serves whose white image has fewer saturated pixels.
SATURATED_SHARE = 0.01


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
    found = [
        {camera: points for camera in _cameras(view) if not isinstance(points := seen[view.name, camera].points, str)}
        for view in run.views
    ]
    if not any(found):
        reasons = list(dict.fromkeys(str(item.points) for item in seen.values()))
        raise InputError(
            run.path,
            f"no board in any of {len(seen)} images ({'; '.join(reasons[:3])})",
            what_would_fit([partial(_grey, *item) for item in images], run.board) or describe_board(run.board),
        )
    codes = []
    for view, points in zip(run.views, found, strict=True):
        codes.append(_decode(view.capture, points, run.board, threads) if view in coded and view.capture else ())
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


def _detect_all(
    run: BoardRun, images: Sequence[tuple[ViewFiles, str]], threads: int, done: _Count
) -> dict[tuple[str, str], _Seen]:
    def work(view: ViewFiles, camera: str) -> _Seen:
        name, image, mask = _image(view, camera)
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


def _image(view: ViewFiles, camera: str) -> tuple[str, NDArray[np.generic], NDArray[np.bool_] | None]:
    """Return name, grey values (H, W) and mask of one camera's image of the board."""
    if view.capture is None:
        file = view.images[camera]
        return f"{file.parent.name}/{file.name}", read_grey(file), None
    capture, mask = view.capture, view.capture.read_mask(camera)
    names = capture.manifest.images.A if camera == "A" else capture.manifest.images.B
    assert names is not None
    index, image = _board_image(capture, camera)
    if mask is not None and mask.shape != image.shape:
        raise InputError(
            f"{capture.path}: mask.{camera}",
            f"is {mask.shape[1]} x {mask.shape[0]} px",
            f"{image.shape[1]} x {image.shape[0]} px, as the images of camera {camera}",
        )
    return f"{view.name}: {names[index]}" if index >= 0 else f"{view.name}: mean of camera {camera}", image, mask


def _grey(view: ViewFiles, camera: str) -> NDArray[np.generic]:
    return _image(view, camera)[1]


def _board_image(capture: Capture, camera: str) -> tuple[int, NDArray[np.generic]]:
    """Return the number in the sequence and the grey values (H, W) of the image that shows the board best.

    It is the white image; of several exposures the longest that is hardly saturated; without any (-1) the mean of the
    sequence, in which the patterns cancel.
    """
    sequence = capture.manifest.sequence
    white = [k for k, entry in enumerate(sequence) if entry.role == "white"]
    white.sort(key=lambda k: -(sequence[k].exposure_ms or 0.0))
    for k in white:
        image = capture.read_image(camera, k)
        full = np.iinfo(image.dtype).max
        if k == white[-1] or np.mean(image >= full) < SATURATED_SHARE:
            return k, image
    lit = [k for k, entry in enumerate(sequence) if entry.role != "black"] or list(range(len(sequence)))
    images = [capture.read_image(camera, k) for k in lit]
    return -1, np.mean(images, axis=0, dtype=np.float32)


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


def _decode(
    capture: Capture, points: dict[str, BoardPoints], board: Board, threads: int
) -> tuple[CodedPoints, ...]:
    """Return the projector's positions at the points, per camera that found the board."""
    if not points:
        return ()
    if capture.manifest.projector_px is None:
        raise InputError(capture.path, "names no size of the projector", "'projector_px', its [width, height]")
    cameras = tuple(points)
    exposures = split_exposures(capture)
    each = [_observe(part, cameras, threads) for _, part in exposures]
    layout = read_layouts(exposures[0][1].manifest, str(capture.path))[0]
    found = []
    for camera in cameras:
        seen = merge_exposures([item[camera] for item in each], [time for time, _ in exposures])
        mask = capture.read_mask(camera)
        if mask is not None:
            seen = seen.without(~mask)
        coded = code_points(straighten(seen, layout.codes, camera).phases, points[camera], board, camera)
        if coded is not None:
            found.append(coded)
    return tuple(found)


def _observe(capture: Capture, cameras: tuple[str, ...], threads: int) -> dict[str, Observation]:
    layout = read_layouts(capture.manifest, str(capture.path))[0]
    again = partial(capture.read_images, threads=threads)
    with ImageReader(capture, cameras, threads) as reader:
        return observe_consistent(
            reader.take, again, cameras, layout, DecodeOptions(), str(capture.path), threads
        )


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
