"""Calibrations by OpenCV, YAML or XML: one camera, two cameras, or a camera and a projector.

x_B = R x_A + T, or x_projector = R x_A + T; pixel (0, 0) at the first pixel's centre: as here, nothing is converted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from planish.errors import InputError
from planish.geometry import Array, compose, require_array
from planish.rig.camera import Camera
from planish.rig.exchange.common import (
    ImportedRig,
    Size,
    device_text,
    devices_to_write,
    losses,
    relative_transform,
    size_of,
    to_size,
    used_coefficients,
)
from planish.rig.parameters import PROJECTOR
from planish.rig.rig import Rig
from planish.storage import replacing

#: Names in use for each matrix; the first that is found counts, and the first is written. "roration" is what a tool in
#: use writes.
_STEREO = {
    "K_A": ("M1", "K1", "cameraMatrix1"),
    "distortion_A": ("D1", "distCoeffs1"),
    "K_B": ("M2", "K2", "cameraMatrix2"),
    "distortion_B": ("D2", "distCoeffs2"),
    "R": ("R", "Rlr"),
    "T": ("T", "Tlr"),
}
_PROJECTOR = {
    "K_A": ("cam_int", "cam_K", "cameraMatrix"),
    "distortion_A": ("cam_dist", "cam_kc", "distCoeffs"),
    "K_B": ("proj_int", "proj_K", "projectorMatrix"),
    "distortion_B": ("proj_dist", "proj_kc", "projectorDistCoeffs"),
    "R": ("rotation", "roration", "R"),
    "T": ("translation", "T"),
}
#: As OpenCV's own calibration sample writes it.
_CAMERA: dict[str, tuple[str, ...]] = {
    "K_A": ("camera_matrix", "cameraMatrix", "cam_int", "cam_K"),
    "distortion_A": ("distortion_coefficients", "distCoeffs", "cam_dist", "cam_kc"),
}
#: Sizes as (width, height), by device; "S" is what a tool in use writes.
_SIZES: dict[str, tuple[str, ...]] = {
    "A": ("imageSize", "image_size", "S"),
    "B": ("imageSize2",),
    PROJECTOR: ("projectorSize",),
}
#: Size of camera A as the shape (height, width) of NumPy, which a tool in use writes.
_SHAPE = "img_shape"
_WIDTH, _HEIGHT = "image_width", "image_height"
#: Numbers of coefficients that are written.
_LENGTHS = (5, 8, 12)

_TABLES = (_STEREO, _PROJECTOR, _CAMERA, _SIZES)
_NAMES = {name for table in _TABLES for names in table.values() for name in names} | {_SHAPE, _WIDTH, _HEIGHT}


def read_opencv_rig(
    files: Sequence[Path], size_px: Size | None = None, projector_px: Size | None = None
) -> ImportedRig:
    """Return the rig in the frame of camera A (the only one, or OpenCV's first) from one or several YAML/XML files.

    Parameters
    ----------
    files : sequence of Path
        Together they hold all matrices.
    size_px : tuple of int or None
        (width, height) of the images; needed where the files do not tell it.
    projector_px : tuple of int or None
        (width, height) of the projector; needed where the files describe one and do not tell its size.

    Raises
    ------
    InputError
        Where a file cannot be read, a matrix is in none of them, or a size is not known or not that of the file.
    """
    subject = ", ".join(map(str, files))
    found = _read_numbers(files)
    sizes = _sizes(found)
    size = size_of("A", sizes.get("A"), size_px, subject, "the size of the images (size_px, --size)")
    kind = _kind(found, subject)
    numbers = _by_meaning(found, kind, subject)
    camera = Camera.make(numbers["K_A"], numbers["distortion_A"], size, np.eye(4), f"{subject}: A")
    if kind is _CAMERA:
        return _imported(Rig({"A": camera}))
    R = require_array(numbers["R"], (3, 3), f"{subject}: R", "a rotation matrix (3, 3)")
    T = compose(R, require_array(np.ravel(numbers["T"]), (3,), f"{subject}: T", "a translation (3,) in mm"))
    second = (numbers["K_B"], numbers["distortion_B"])
    if kind is _STEREO:
        size = sizes.get("B", size)
        return _imported(Rig({"A": camera, "B": Camera.make(*second, size, T, f"{subject}: B")}))
    option = "'projector_px' in the manifest, or --projector-size"
    size = size_of(PROJECTOR, sizes.get(PROJECTOR), projector_px, subject, option)
    return _imported(Rig({"A": camera}, Camera.make(*second, size, T, f"{subject}: {PROJECTOR}")))


def write_opencv_rig(rig: Rig, path: Path, devices: Sequence[str] | None = None) -> tuple[str, ...]:
    """Write an OpenCV calibration file, YAML (.yml, .yaml) or XML (.xml), and return what of the rig is not in it.

    Parameters
    ----------
    rig : Rig
        The rig.
    path : Path
        The file.
    devices : sequence of str or None
        The one or two devices to write, a camera first; default: all. A rig of two cameras and a projector needs two
        files, for OpenCV has names for two devices.

    Raises
    ------
    InputError
        Where the devices are no such choice, or a camera has skew, which OpenCV's functions ignore.
    """
    allowed = "one camera, or a camera and one more device: A,B or A,projector, each in a file of its own"
    names = devices_to_write(rig, devices, path, allowed)
    for name in names:
        _refuse_skew(rig.devices[name], f"{path}: {device_text(name)}")
    kind = _CAMERA if len(names) == 1 else _PROJECTOR if names[1] == PROJECTOR else _STEREO
    suffix = ".xml" if Path(path).suffix.lower() == ".xml" else ".yml"
    out = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, part in zip(names, "AB", strict=False):
        out.write(kind[f"K_{part}"][0], rig.devices[name].K)
        out.write(kind[f"distortion_{part}"][0], used_coefficients(rig.devices[name], _LENGTHS)[None])
    if kind is _CAMERA:
        for key, value in zip((_WIDTH, _HEIGHT), rig.devices[names[0]].size_px, strict=True):
            out.write(key, value)
    else:
        T = relative_transform(rig, *names)
        out.write(kind["R"][0], T[:3, :3])
        out.write(kind["T"][0], T[:3, 3:])
        for name, role in zip(names, ("A", PROJECTOR if kind is _PROJECTOR else "B"), strict=True):
            _write_size(out, _SIZES[role][0], rig.devices[name].size_px)
    text = out.releaseAndGetString()
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return losses(rig, names, "OpenCV")


def _write_size(out: Any, name: str, size: Size) -> None:
    # As C++ writes a cv::Size.
    out.startWriteStruct(name, cv2.FileNode_SEQ | cv2.FileNode_FLOW, "")
    for number in size:
        out.write("", number)
    out.endWriteStruct()


def _refuse_skew(camera: Camera, subject: str) -> None:
    # OpenCV calib3d, projectPoints: of the camera matrix, fx, fy, cx and cy alone are used.
    if camera.K[0, 1] != 0:
        raise InputError(subject, f"has a skew of {camera.K[0, 1]:.6g} px", "no skew: OpenCV's functions ignore it")


def _imported(rig: Rig) -> ImportedRig:
    second = PROJECTOR if rig.projector is not None else "B"
    notes = ["pixel (0, 0) is the centre of the first pixel, lengths are in mm: nothing was converted"]
    if len(rig.devices) > 1:
        notes.append(f"x_{second} = R x_A + T; the sensor frame is that of camera A")
    for name, device in rig.devices.items():
        if device.K[0, 1] != 0:
            notes.append(f"{device_text(name)}: a skew of {device.K[0, 1]:.6g} px, which OpenCV's functions ignore")
    return ImportedRig(rig, "OpenCV", tuple(notes))


def _read_numbers(files: Sequence[Path]) -> dict[str, Array]:
    found: dict[str, Array] = {}
    for path in files:
        if not Path(path).is_file():
            raise InputError(path, "no such file", "an OpenCV calibration file")
        try:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            for name in _NAMES:
                node = storage.getNode(name)
                if name not in found and (numbers := _numbers(node, f"{path}: {name}")) is not None:
                    found[name] = numbers
        # OpenCV's Python binding reports a file that it cannot parse as SystemError.
        except (cv2.error, SystemError) as error:
            cause = getattr(error, "err", "") or "no YAML or XML that it can parse"
            raise InputError(path, f"cannot be read by OpenCV ({cause})", "an OpenCV calibration file") from None
    return found


def _numbers(node: Any, subject: str) -> Array | None:
    """A matrix, a row of numbers or a single number of a file, or None."""
    if node.empty():
        return None
    if not node.isMap():
        row = _row(node)
        return row if row.size else None
    # OpenCV's own reading of a matrix writes outside its memory where a part is missing (seen with 5.0). "sizes" stands
    # where recent releases write a vector.
    parts = ("rows", "cols") if node.getNode("sizes").empty() else ("sizes",)
    lengths = [_row(node.getNode(part)) for part in parts]
    shape, data = np.concatenate(lengths), _row(node.getNode("data"))
    if not all(length.size for length in lengths) or shape.min() < 0 or data.size != shape.prod():
        raise InputError(subject, "no whole matrix", "'rows', 'cols' and as many numbers in 'data'")
    return data.reshape(shape.astype(int))


def _row(node: Any) -> Array:
    """The numbers of a sequence, or a single one; none where there is anything else."""
    items = [node.at(i) for i in range(node.size())] if node.isSeq() or node.empty() else [node]
    whole = all(item.isInt() or item.isReal() for item in items)
    return np.array([item.real() for item in items] if whole else [], float)


def _sizes(found: Mapping[str, Array]) -> dict[str, Size]:
    """Sizes by device, of those that the file tells."""
    told = [(device, found[name]) for device, names in _SIZES.items() for name in names if name in found]
    if _SHAPE in found:
        told.append(("A", found[_SHAPE].ravel()[::-1]))
    if _WIDTH in found and _HEIGHT in found:
        told.append(("A", np.concatenate([found[_WIDTH].ravel(), found[_HEIGHT].ravel()])))
    sizes: dict[str, Size] = {}
    for device, numbers in told:
        size = to_size(numbers)
        if size is not None:
            sizes.setdefault(device, size)
    return sizes


def _kind(found: Mapping[str, Array], subject: str) -> dict[str, tuple[str, ...]]:
    """The table of names that this calibration uses, told by the camera matrices that are there."""

    def holds(names: tuple[str, ...]) -> bool:
        return any(name in found for name in names)

    if holds(_PROJECTOR["K_B"]):
        return _PROJECTOR
    if holds(_STEREO["K_A"]) or holds(_STEREO["K_B"]):
        return _STEREO
    if holds(_CAMERA["K_A"]):
        return _CAMERA
    expected = [names[0] for names in (_STEREO["K_A"], _PROJECTOR["K_A"], _CAMERA["K_A"])]
    raise InputError(subject, "no camera matrix", f"one named {', '.join(expected)} or as docs/formats.md lists them")


def _by_meaning(found: Mapping[str, Array], keys: Mapping[str, tuple[str, ...]], subject: str) -> dict[str, Array]:
    numbers = {}
    for key, names in keys.items():
        given = [name for name in names if name in found]
        if not given:
            raise InputError(subject, f"no matrix named {' or '.join(names)}", f"the matrix {key}")
        numbers[key] = found[given[0]]
    return numbers
