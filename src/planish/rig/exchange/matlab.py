"""Calibrations by MATLAB's Computer Vision Toolbox: the struct of `toStruct` in a MAT-file.

Pixel (1, 1) is the centre of the first pixel, and matrices of the older fields multiply row vectors from the right.

Notes
-----
MathWorks, reference pages cameraParameters and stereoParameters (R2021a: IntrinsicMatrix, RotationOfCamera2; today: K,
PoseCamera2) and toStruct of both; "Image Coordinate Systems" (centre of the first pixel); stereoParametersToOpenCV
(principal point minus 1); "Migrate Geometric Transformations to Premultiply Convention" (R2022b). Support answer
502227: [x y z] of camera 2 = [x y z] of camera 1 * RotationOfCamera2 + TranslationOfCamera2.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from planish.errors import InputError
from planish.geometry import Array, compose, require_array
from planish.rig.camera import Camera
from planish.rig.exchange.common import ImportedRig, Size, size_of, to_size
from planish.rig.exchange.mat_file import read_mat_file
from planish.rig.exchange.mat_values import MatlabObject, Value
from planish.rig.rig import Rig

#: Of stereoParameters.
CAMERAS = ("CameraParameters1", "CameraParameters2")
#: Millimetres per unit; WorldUnits is free text, the app writes the plurals.
_MM = {
    1.0: ("mm", "millimeter", "millimeters", "millimetre", "millimetres"),
    10.0: ("cm", "centimeter", "centimeters", "centimetre", "centimetres"),
    1000.0: ("m", "meter", "meters", "metre", "metres"),
    25.4: ("in", "inch", "inches"),
}
#: (1, 1) is the centre of MATLAB's first pixel, (0, 0) ours.
ORIGIN = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
#: Numbers of radial coefficients: k1 k2, k1 k2 k3, or (recent releases) k1 ... k6 of the rational model.
_RADIAL = (2, 3, 6)


def read_matlab_rig(path: Path, size_px: Size | None = None, variable: str | None = None) -> ImportedRig:
    """Return the rig (camera A, or A and B in the frame of A) of a struct from `toStruct`.

    Parameters
    ----------
    path : Path
        MAT-file of any version.
    size_px : tuple of int or None
        (width, height) of the images; needed where ImageSize is empty.
    variable : str or None
        The variable to read; needed where several are calibrations.

    Raises
    ------
    InputError
        Where the file cannot be read, holds no such struct (but an object of a class, say), or the struct is not
        understood: a fisheye model, an unknown unit, a missing field.
    """
    name, content = _choose(read_mat_file(path), variable, path)
    subject = f"{path}: {name}"
    notes = [f"the struct '{name}'; pixel centres start at (1, 1): principal points moved by -1 px"]
    if CAMERAS[0] not in content:
        notes.append(_matrix_note(content))
        return ImportedRig(Rig({"A": _camera(content, np.eye(4), size_px, subject)}), "MATLAB", tuple(notes))
    first, second = (_struct(content[key], f"{subject}.{key}") for key in CAMERAS)
    unit, scale = _unit(first, f"{subject}.{CAMERAS[0]}")
    if _unit(second, f"{subject}.{CAMERAS[1]}")[1] != scale:
        raise InputError(subject, "WorldUnits of the two cameras differ", "one unit")
    T, note = _camera_2(content, scale, subject)
    notes += [_matrix_note(first), note]
    if scale != 1:
        notes.append(f"WorldUnits is '{unit}': lengths times {scale:g}")
    cameras = {
        "A": _camera(first, np.eye(4), size_px, f"{subject}.{CAMERAS[0]}"),
        "B": _camera(second, T, size_px, f"{subject}.{CAMERAS[1]}"),
    }
    return ImportedRig(Rig(cameras), "MATLAB", tuple(notes))


def _choose(variables: Mapping[str, Value], variable: str | None, path: Path) -> tuple[str, Mapping[str, Value]]:
    """Name and content of the one calibration among the variables."""
    if variable is not None:
        if variable not in variables:
            raise InputError(path, f"has no variable '{variable}'", f"one of {', '.join(variables) or 'none'}")
        variables = {variable: variables[variable]}
    usable = {name: value for name, value in variables.items() if isinstance(value, dict) and _is_calibration(value)}
    if len(usable) == 1:
        ((name, content),) = usable.items()
        return name, content
    if usable:
        raise InputError(path, f"holds several calibrations: {', '.join(usable)}", "the name of one (--variable)")
    for name, value in variables.items():
        _refuse(name, value, path)
    raise InputError(
        path,
        f"no calibration among the variables {', '.join(variables) or '(none)'}",
        "a struct s = toStruct(stereoParams) or toStruct(cameraParams), saved by save('x.mat', 's')",
    )


def _is_calibration(value: Mapping[str, Value]) -> bool:
    return all(name in value for name in CAMERAS) or any(name in value for name in ("K", "IntrinsicMatrix"))


def _refuse(name: str, value: Value, path: Path) -> None:
    """Say of a variable that looks like a calibration why it is none."""
    fields = value if isinstance(value, dict) else {}
    class_name = value.class_name if isinstance(value, MatlabObject) else ""
    if "fisheye" in class_name.lower() or any("MappingCoefficients" in part for part in (fields, *_structs(fields))):
        raise InputError(f"{path}: {name}", "a fisheye model", "the pinhole model: cameraParameters, stereoParameters")
    if class_name:
        # Sessions of the calibrator apps hold the parameters.
        source = f"{name}.CameraParameters" if class_name.endswith("Session") else name
        raise InputError(
            f"{path}: {name}",
            f"an object of the class {class_name}, which only MATLAB can read",
            f"a struct, saved by s = toStruct({source}); save('x.mat', 's')",
        )


def _structs(fields: Mapping[str, Value]) -> list[Mapping[str, Value]]:
    return [value for value in fields.values() if isinstance(value, dict)]


def _struct(value: Value, subject: str) -> Mapping[str, Value]:
    if isinstance(value, dict):
        return value
    raise InputError(subject, f"found {_text(value)}", "a struct, as toStruct(stereoParams) makes it")


def _text(value: Any) -> str:
    return f"an object of the class {value.class_name}" if isinstance(value, MatlabObject) else type(value).__name__


def _camera(content: Mapping[str, Value], T_camera_sensor: Array, size_px: Size | None, subject: str) -> Camera:
    expected = "a 3 x 3 matrix"
    if "K" in content:
        K = require_array(_array(content, "K", subject), (3, 3), f"{subject}.K", expected)
    else:
        K = require_array(_array(content, "IntrinsicMatrix", subject), (3, 3), f"{subject}.IntrinsicMatrix", expected).T
    radial = np.ravel(_array(content, "RadialDistortion", subject))
    if len(radial) not in _RADIAL:
        raise InputError(f"{subject}.RadialDistortion", f"found {len(radial)} coefficients", f"one of {_RADIAL}")
    tangential = np.ravel(_array(content, "TangentialDistortion", subject))
    tangential = require_array(tangential, (2,), f"{subject}.TangentialDistortion", "2 coefficients")
    # [height, width], or empty.
    found = to_size(np.ravel(_array(content, "ImageSize", subject))[::-1]) if "ImageSize" in content else None
    size = size_of("ImageSize", found, size_px, subject, "the size of the images (size_px, --size)")
    distortion = np.concatenate([radial[:2], tangential, radial[2:]])
    if len(distortion) == 4 + 4:  # k1 k2 p1 p2 k3 k4 k5 k6
        return Camera.make(K - ORIGIN, distortion, size, T_camera_sensor, subject)
    return Camera.make(K - ORIGIN, np.append(distortion, np.zeros(5 - len(distortion))), size, T_camera_sensor, subject)


def _array(content: Mapping[str, Value], field: str, subject: str) -> Array:
    if field not in content:
        raise InputError(subject, f"no field '{field}'", "the fields of toStruct(cameraParams)")
    value = content[field]
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        raise InputError(f"{subject}.{field}", f"found {_text(value)}", "numbers")
    return value.astype(np.float64)


def _matrix_note(content: Mapping[str, Value]) -> str:
    return "K as it stands" if "K" in content else "IntrinsicMatrix multiplies row vectors: transposed"


def _camera_2(content: Mapping[str, Value], scale: float, subject: str) -> tuple[Array, str]:
    """T_2_1 (4, 4) [mm], and how it was read."""
    rotation = "a rotation matrix (3, 3)"
    if "RotationOfCamera2" in content:
        R = require_array(
            _array(content, "RotationOfCamera2", subject), (3, 3), f"{subject}.RotationOfCamera2", rotation
        )
        t = np.ravel(_array(content, "TranslationOfCamera2", subject))
        t = require_array(t, (3,), f"{subject}.TranslationOfCamera2", "3 numbers")
        return compose(R.T, scale * t), "RotationOfCamera2 multiplies row vectors, x_B' = x_A' R + t': transposed"
    if "PoseCamera2" not in content:
        raise InputError(
            subject, "no field 'RotationOfCamera2' or 'PoseCamera2'", "the fields of toStruct(stereoParams)"
        )
    pose = content["PoseCamera2"]
    if isinstance(pose, np.ndarray):
        pose = {"A": pose}
    if not isinstance(pose, dict):
        raise InputError(
            f"{subject}.PoseCamera2", f"found {_text(pose)}", "a matrix: s.PoseCamera2 = stereoParams.PoseCamera2.A"
        )
    where = f"{subject}.PoseCamera2"
    if "A" in pose:
        A = require_array(_array(pose, "A", where), (4, 4), f"{where}.A", "a rigid transform (4, 4)")
        R, t = A[:3, :3], A[:3, 3]
    else:
        R = require_array(_array(pose, "R", where), (3, 3), f"{where}.R", rotation)
        t = require_array(np.ravel(_array(pose, "Translation", where)), (3,), f"{where}.Translation", "3 numbers")
    return compose(R, scale * t), "PoseCamera2 maps points of camera 1 into camera 2: as it stands"


def _unit(content: Mapping[str, Value], subject: str) -> tuple[str, float]:
    unit = content.get("WorldUnits")
    for scale, names in _MM.items():
        if isinstance(unit, str) and unit.strip().lower() in names:
            return unit, scale
    found = f"found '{unit}'" if isinstance(unit, str) else f"found {_text(unit)}"
    raise InputError(f"{subject}.WorldUnits", found, "mm, cm, m or inches, as text in single quotes")
