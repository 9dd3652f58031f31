"""Import of a stereo calibration from OpenCV YAML files: x_B = R x_A + T, pixel (0, 0) at the first pixel's centre."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from planish.errors import InputError
from planish.geometry import Array, compose, require_array
from planish.rig import Camera, Rig

#: Names in use for each matrix, the first that is found counts.
_KEYS = {
    "K_A": ("M1", "K1", "cameraMatrix1"),
    "K_B": ("M2", "K2", "cameraMatrix2"),
    "distortion_A": ("D1", "distCoeffs1"),
    "distortion_B": ("D2", "distCoeffs2"),
    "R": ("R", "Rlr"),
    "T": ("T", "Tlr"),
}


def read_opencv_rig(files: Sequence[Path], size_px: tuple[int, int]) -> Rig:
    """Return the rig in the frame of camera A (OpenCV's first, left camera) from one or several YAML/XML files.

    Raises
    ------
    InputError
        Where a file cannot be read or a matrix is in none of them.
    """
    found: dict[str, Array] = {}
    for path in files:
        if not Path(path).is_file():
            raise InputError(path, "no such file", "an OpenCV calibration file")
        try:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            for key, names in _KEYS.items():
                for name in names:
                    node = storage.getNode(name)
                    if key not in found and not node.empty() and node.mat() is not None:
                        found[key] = np.asarray(node.mat(), float)
        # OpenCV's Python binding reports a file that it cannot parse as SystemError.
        except (cv2.error, SystemError) as error:
            cause = getattr(error, "err", "") or "no YAML or XML that it can parse"
            raise InputError(path, f"cannot be read by OpenCV ({cause})", "an OpenCV calibration file") from None
    for key, names in _KEYS.items():
        if key not in found:
            raise InputError(", ".join(map(str, files)), f"no matrix named {' or '.join(names)}", f"the matrix {key}")
    subject = ", ".join(map(str, files))
    R = require_array(found["R"], (3, 3), f"{subject}: R", "a rotation matrix (3, 3)")
    T = require_array(np.ravel(found["T"]), (3,), f"{subject}: T", "a translation (3,) in mm")
    transforms = {"A": np.eye(4), "B": compose(R, T)}
    return Rig(
        {
            name: Camera.make(
                found[f"K_{name}"], found[f"distortion_{name}"], size_px, T_camera_sensor, f"{subject}: {name}"
            )
            for name, T_camera_sensor in transforms.items()
        }
    )
