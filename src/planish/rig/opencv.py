"""Import of a calibration by OpenCV, YAML or XML: two cameras, or a camera and a projector.

x_B = R x_A + T, or x_projector = R x_A + T; pixel (0, 0) at the first pixel's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from planish.errors import InputError
from planish.geometry import Array, compose, require_array
from planish.rig.camera import Camera
from planish.rig.rig import Rig

#: Names in use for each matrix, the first that is found counts. "roration" is what a tool in use writes.
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
#: A file that holds one of these describes a projector.
_PROJECTOR_MATRIX = _PROJECTOR["K_B"]


def read_opencv_rig(
    files: Sequence[Path], size_px: tuple[int, int], projector_px: tuple[int, int] | None = None
) -> Rig:
    """Return the rig in the frame of camera A (the only one, or OpenCV's first) from one or several YAML/XML files.

    Parameters
    ----------
    files : sequence of Path
        Together they hold all matrices.
    size_px : tuple of int
        (width, height) of the images.
    projector_px : tuple of int or None
        (width, height) of the projector; needed where the files describe one, for they do not tell it.

    Raises
    ------
    InputError
        Where a file cannot be read, a matrix is in none of them, or the projector's size is not known.
    """
    subject = ", ".join(map(str, files))
    matrices = _read_matrices(files)
    projector = any(name in matrices for name in _PROJECTOR_MATRIX)
    found = _by_meaning(matrices, _PROJECTOR if projector else _STEREO, subject)
    R = require_array(found["R"], (3, 3), f"{subject}: R", "a rotation matrix (3, 3)")
    T = require_array(np.ravel(found["T"]), (3,), f"{subject}: T", "a translation (3,) in mm")
    camera = Camera.make(found["K_A"], found["distortion_A"], size_px, np.eye(4), f"{subject}: A")
    second = (found["K_B"], found["distortion_B"])
    if not projector:
        return Rig({"A": camera, "B": Camera.make(*second, size_px, compose(R, T), f"{subject}: B")})
    if projector_px is None:
        raise InputError(
            f"{subject}: projector", "its size is not in the calibration", "'projector_px' in the manifest"
        )
    return Rig({"A": camera}, Camera.make(*second, projector_px, compose(R, T), f"{subject}: projector"))


def _read_matrices(files: Sequence[Path]) -> dict[str, Array]:
    found: dict[str, Array] = {}
    for path in files:
        if not Path(path).is_file():
            raise InputError(path, "no such file", "an OpenCV calibration file")
        try:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            for name in {name for keys in (_STEREO, _PROJECTOR) for names in keys.values() for name in names}:
                node = storage.getNode(name)
                if name not in found and not node.empty() and node.mat() is not None:
                    found[name] = np.asarray(node.mat(), float)
        # OpenCV's Python binding reports a file that it cannot parse as SystemError.
        except (cv2.error, SystemError) as error:
            cause = getattr(error, "err", "") or "no YAML or XML that it can parse"
            raise InputError(path, f"cannot be read by OpenCV ({cause})", "an OpenCV calibration file") from None
    return found


def _by_meaning(matrices: dict[str, Array], keys: dict[str, tuple[str, ...]], subject: str) -> dict[str, Array]:
    found = {}
    for key, names in keys.items():
        given = [name for name in names if name in matrices]
        if not given:
            raise InputError(subject, f"no matrix named {' or '.join(names)}", f"the matrix {key}")
        found[key] = matrices[given[0]]
    return found
