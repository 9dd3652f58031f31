"""Rigs in files of any kind: planish's own rig.json, OpenCV's YAML or XML, MATLAB's struct in a MAT-file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from planish.errors import InputError
from planish.rig.exchange.common import ImportedRig, Size
from planish.rig.exchange.matlab import read_matlab_rig
from planish.rig.exchange.matlab_export import write_matlab_rig
from planish.rig.exchange.opencv import read_opencv_rig, write_opencv_rig
from planish.rig.rig import Rig

#: What a reader is told where a file is nothing of that.
KINDS = "a rig.json, an OpenCV calibration (YAML, XML), or a MAT-file with the struct of toStruct"
#: Endings of files that are written, and who reads them.
_OPENCV, _MATLAB, _PLANISH = (".yml", ".yaml", ".xml"), ".mat", ".json"
#: How the files begin, and what OpenCV's matrices are marked with: OpenCV writes JSON, too.
_MATLAB_HEAD, _OPENCV_HEADS, _OPENCV_MARK = b"MATLAB", (b"%YAML", b"<?xml"), b"opencv-matrix"


def read_rig(
    paths: str | Path | Sequence[str | Path],
    size_px: Size | None = None,
    projector_px: Size | None = None,
    variable: str | None = None,
) -> Rig:
    """Return the rig of a file of any kind; see `import_rig`, which also tells what was converted."""
    return import_rig(paths, size_px, projector_px, variable).rig


def import_rig(
    paths: str | Path | Sequence[str | Path],
    size_px: Size | None = None,
    projector_px: Size | None = None,
    variable: str | None = None,
) -> ImportedRig:
    """Return the rig of a file of any kind, whose it was, and what was converted.

    Parameters
    ----------
    paths : path or sequence of path
        A rig.json, a MAT-file, or one or several files of one OpenCV calibration. Their content tells them apart.
    size_px : tuple of int or None
        (width, height) of the images of OpenCV's and MATLAB's cameras; needed where the file does not tell it, and
        refused where it tells another.
    projector_px : tuple of int or None
        The same of OpenCV's projector.
    variable : str or None
        The variable of a MAT-file with several calibrations.

    Raises
    ------
    InputError
        Where a file is missing, damaged or none of these; the message names it.
    """
    files = [Path(paths)] if isinstance(paths, (str, os.PathLike)) else [Path(path) for path in paths]
    if not files:
        raise InputError("rig", "no file", KINDS)
    kinds = [rig_format(path) for path in files]
    if len(files) > 1 and set(kinds) != {"OpenCV"}:
        found = ", ".join(f"{path} ({kind})" for path, kind in zip(files, kinds, strict=True))
        raise InputError("rig", f"several files: {found}", "one file, or several of one OpenCV calibration")
    if kinds[0] == "planish":
        return ImportedRig(Rig.load(files[0]), "planish")
    if kinds[0] == "MATLAB":
        return read_matlab_rig(files[0], size_px, variable)
    return read_opencv_rig(files, size_px, projector_px)


def write_rig(rig: Rig, path: str | Path, devices: Sequence[str] | None = None) -> tuple[str, ...]:
    """Write a rig to .json (planish), .yml, .yaml, .xml (OpenCV) or .mat (MATLAB); return what is not in the file.

    Parameters
    ----------
    rig : Rig
        The rig.
    path : path
        The file; its ending tells the kind.
    devices : sequence of str or None
        What to write into a file of OpenCV or MATLAB; default: all. A rig.json always holds all.

    Raises
    ------
    InputError
        Where the ending is another, or the file's kind cannot hold the rig: the message says what of it.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in _OPENCV:
        return write_opencv_rig(rig, path, devices)
    if suffix == _MATLAB:
        return write_matlab_rig(rig, path, devices)
    if suffix != _PLANISH:
        raise InputError(path, f"ends in '{path.suffix}'", f"one of {', '.join((_PLANISH, *_OPENCV, _MATLAB))}")
    if devices is not None and set(devices) != set(rig.devices):
        raise InputError(f"{path}: devices", f"found {', '.join(devices)}", "all: a rig.json holds the whole rig")
    rig.save(path)
    return ()


def rig_format(path: Path) -> Literal["planish", "OpenCV", "MATLAB"]:
    """Return whose file it is, told by its first bytes, else by its ending.

    Raises
    ------
    InputError
        Where the file cannot be read or is none of these.
    """
    try:
        with path.open("rb") as file:
            head = file.read(1 << 16).lstrip()
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", KINDS) from None
    suffix = path.suffix.lower()
    if head.startswith(_MATLAB_HEAD) or suffix == _MATLAB:
        return "MATLAB"
    if head.startswith(_OPENCV_HEADS) or _OPENCV_MARK in head or suffix in _OPENCV:
        return "OpenCV"
    if head.startswith(b"{") or suffix == _PLANISH:
        return "planish"
    raise InputError(path, "no calibration that planish knows", KINDS)
