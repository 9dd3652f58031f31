"""The board run: which images and captures show the board (`boards.json`, planish.boards/1, or a folder of images)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from planish import storage
from planish.errors import InputError
from planish.options import Strict
from planish.sensing.capture.board import Board, load_board, parse_board
from planish.sensing.capture.manifest import Capture, inside_folder

RUN_FILE, BOARD_FILE, CAPTURE_FILE = "boards.json", "board.json", "capture.json"
#: Endings of files that are taken for images.
IMAGE_ENDINGS = (".png", ".tif", ".tiff", ".bmp", ".pgm", ".jpg", ".jpeg")
CAMERAS = ("A", "B")
#: What may tell the cameras apart at the beginning or end of a file's name.
_WORD, _LETTER = r"(?:cam(?:era)?[-_ ]?[0-9ab]|left|right)", "[ablr]"
_LEADING = re.compile(rf"^(?:{_WORD}[-_ ]|left|right|{_LETTER}[-_ ])(?=.)", re.IGNORECASE)
_TRAILING = re.compile(rf"(?<=.)(?:[-_ ]{_WORD}|left|right|[-_ ]{_LETTER})$", re.IGNORECASE)
#: So many names stand in a message.
NAMED = 5


class ViewEntry(Strict):
    """One position of the board: an image per camera, or a capture."""

    name: str = Field(min_length=1)
    A: str | None = None
    B: str | None = None
    capture: str | None = None

    @model_validator(mode="after")
    def _one_or_the_other(self) -> ViewEntry:
        if (self.capture is None) == (self.A is None and self.B is None):
            raise ValueError("give images 'A', 'B' or both, or a 'capture'")
        return self


class RunFile(Strict):
    """Content of `boards.json`; `board` is an object as in `board.json`, or that file's name."""

    schema_: Literal["planish.boards/1"] = Field(alias="schema")
    board: str | dict[str, Any] | None = None
    views: list[ViewEntry] = Field(min_length=1)


@dataclass(frozen=True)
class ViewFiles:
    """Where one view lies: images per camera, or a capture."""

    name: str
    images: Mapping[str, Path]
    capture: Capture | None


@dataclass(frozen=True)
class BoardRun:
    """A board and the files that show it.

    Parameters
    ----------
    path : Path
        The manifest or folder; errors name it.
    board : Board
        What is printed on it.
    views : tuple of ViewFiles
        In the order of the manifest or of their names.
    """

    path: Path
    board: Board
    views: tuple[ViewFiles, ...]


def load_run(path: Path, board: Path | Board | None = None, images_dir: Path | None = None) -> BoardRun:
    """Return the board run of a `boards.json` or of a folder.

    Parameters
    ----------
    path : Path
        A `boards.json`; a folder that holds one; or a folder with `board.json` and the images in `A/` and `B/` (of the
        same names in both), or with a folder with a `capture.json` for each position of the board.
    board : Path, Board or None
        Board, or its file, instead of the one that the run names.
    images_dir : Path or None
        Folder that images' names are relative to; default the manifest's folder.

    Raises
    ------
    InputError
        Where files are missing, unpaired, or lie elsewhere.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(path, "no such file or folder", f"a {RUN_FILE}, or a folder of board images")
    if path.is_dir() and (path / RUN_FILE).is_file():
        path = path / RUN_FILE
    if path.is_dir():
        folder = path if images_dir is None else Path(images_dir)
        # First the images: of a folder without any, they are what is missing.
        views = _views_of_folder(folder)
        return BoardRun(path, _board_of_folder(path, board), views)
    content = RunFile.parse(storage.read_json(path), str(path))
    names = [view.name for view in content.views]
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise InputError(path, f"several views are called {', '.join(twice)}", "a name of its own for each view")
    return BoardRun(path, _board_of_file(path, content, board), _views_of_file(path, content, images_dir))


def _board_of_folder(folder: Path, board: Path | Board | None) -> Board:
    if board is None:
        file = folder / BOARD_FILE
        if not file.is_file():
            raise InputError(folder, f"holds no {BOARD_FILE}", f"{BOARD_FILE} in it, or --board FILE: what is printed")
        return load_board(file)
    return load_board(board) if isinstance(board, Path) else board


def _board_of_file(path: Path, content: RunFile, board: Path | Board | None) -> Board:
    if board is not None:
        return load_board(board) if isinstance(board, Path) else board
    if isinstance(content.board, dict):
        return parse_board(content.board, f"{path}: board")
    if content.board is not None:
        return load_board(inside_folder(path.parent, content.board, path))
    if (path.parent / BOARD_FILE).is_file():
        return load_board(path.parent / BOARD_FILE)
    raise InputError(path, "names no board", f"'board', a {BOARD_FILE} beside it, or --board FILE")


def _views_of_file(path: Path, content: RunFile, images_dir: Path | None) -> tuple[ViewFiles, ...]:
    folder = path.parent if images_dir is None else Path(images_dir)
    views = []
    for view in content.views:
        if view.capture is None:
            named = {camera: name for camera, name in (("A", view.A), ("B", view.B)) if name is not None}
            images = {camera: inside_folder(folder, name, path) for camera, name in named.items()}
            views.append(ViewFiles(view.name, images, None))
            continue
        manifest = inside_folder(path.parent, view.capture, path)
        views.append(ViewFiles(view.name, {}, Capture.load(manifest, images_dir)))
    return tuple(views)


def _views_of_folder(folder: Path) -> tuple[ViewFiles, ...]:
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a folder of board images")
    captures = sorted(file.parent for file in folder.glob(f"*/{CAPTURE_FILE}"))
    images = {camera: _images(folder / camera) for camera in CAMERAS if (folder / camera).is_dir()}
    images = {camera: files for camera, files in images.items() if files}
    if captures and images:
        raise InputError(
            folder,
            f"holds camera folders ({', '.join(images)}) and captures ({_listed([c.name for c in captures])})",
            f"one or the other, or a {RUN_FILE} that names both",
        )
    if captures:
        return tuple(ViewFiles(found.name, {}, Capture.load(found)) for found in captures)
    if not images:
        raise InputError(
            folder,
            "holds no images of a board",
            f"a {RUN_FILE}, images in the folders A and B, or a folder with a {CAPTURE_FILE} per position of the board",
        )
    if len(images) == 1:
        ((camera, files),) = images.items()
        return tuple(ViewFiles(file.stem, {camera: file}, None) for file in files)
    return _paired(folder, images["A"], images["B"])


def _images(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.is_file() and file.suffix.lower() in IMAGE_ENDINGS)


def _paired(folder: Path, a: list[Path], b: list[Path]) -> tuple[ViewFiles, ...]:
    """Return the views of images with equal names, in part after a word for the camera has been taken off."""
    for key in (_whole_name, _without_camera):
        named = [{key(file): file for file in files} for files in (a, b)]
        unique = len(named[0]) == len(a) and len(named[1]) == len(b)
        if unique and named[0].keys() == named[1].keys():
            return tuple(ViewFiles(name, {"A": named[0][name], "B": named[1][name]}, None) for name in sorted(named[0]))
    # Whichever way of comparing leaves fewer unpaired says best which are missing.
    left: list[list[str]] = []
    for key in (_whole_name, _without_camera):
        others = [{key(file) for file in files} for files in (b, a)]
        alone = [
            [file for file in files if key(file) not in other] for files, other in zip((a, b), others, strict=True)
        ]
        left.append([str(file.relative_to(folder)) for files in alone for file in files])
    unpaired = min((names for names in left if names), key=len, default=left[0])
    counts = f"{len(a)} images in A and {len(b)} in B; " if len(a) != len(b) else ""
    raise InputError(
        folder,
        f"{counts}without a partner: {_listed(unpaired)}" if unpaired else f"{counts}names that fit several partners",
        "for each position of the board an image in A and one in B of the same name (left and right, cam0 and cam1, "
        f"L and R before or after it may differ), or a {RUN_FILE} that says what belongs together",
    )


def _whole_name(file: Path) -> str:
    return file.stem


def _without_camera(file: Path) -> str:
    return _TRAILING.sub("", _LEADING.sub("", file.stem))


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
