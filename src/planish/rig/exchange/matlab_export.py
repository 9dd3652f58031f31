"""Rigs as MATLAB's Computer Vision Toolbox takes them: the struct that cameraParameters and stereoParameters accept."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from planish.errors import InputError
from planish.rig.camera import Camera
from planish.rig.exchange.common import device_text, devices_to_write, losses, relative_transform, used_coefficients
from planish.rig.exchange.matlab import CAMERAS, ORIGIN
from planish.rig.parameters import DISTORTION, PROJECTOR
from planish.rig.rig import Rig
from planish.storage import replacing

#: Text at the head of a MAT-file; SciPy's own holds the time.
_HEADER = b"MATLAB 5.0 MAT-file, written by planish"
_HEADER_LENGTH = 116


def write_matlab_rig(rig: Rig, path: Path, devices: Sequence[str] | None = None) -> tuple[str, ...]:
    """Write a struct that MATLAB turns into its object, and return what of the rig is not in it, or only for some.

    Two cameras are the variable `stereoParams`, one is `cameraParams`; in MATLAB

        s = load('rig.mat');
        stereoParams = stereoParameters(s.stereoParams);   % or cameraParameters(s.cameraParams)

    Parameters
    ----------
    rig : Rig
        The rig.
    path : Path
        The file (.mat, version 5).
    devices : sequence of str or None
        The one or two cameras to write; default: all.

    Raises
    ------
    InputError
        Where a projector is among the devices, or a camera has thin-prism distortion: MATLAB knows neither.
    """
    from scipy.io import savemat  # takes a third of a second to be imported

    names = devices_to_write(rig, devices, path, "one or two cameras, for MATLAB knows no projector: A or A,B")
    if PROJECTOR in names:
        raise InputError(f"{path}: devices", "a projector", "cameras, for MATLAB knows no projector: A or A,B")
    structs = [_to_struct(rig.devices[name], f"{path}: {device_text(name)}") for name in names]
    content: dict[str, Any] = {"cameraParams": structs[0]}
    if len(names) == 2:
        T = relative_transform(rig, *names)
        content = {
            "stereoParams": {
                **dict(zip(CAMERAS, structs, strict=True)),
                "RotationOfCamera2": T[:3, :3].T,
                "TranslationOfCamera2": T[None, :3, 3],
                "RectificationParams": {"Initialized": np.array([[False]])},
            }
        }
    buffer = io.BytesIO()
    savemat(buffer, content, oned_as="row")
    data = _HEADER.ljust(_HEADER_LENGTH) + buffer.getvalue()[_HEADER_LENGTH:]
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(data)
    rational = [name for name in names if len(used_coefficients(rig.devices[name], (5, 8))) == 8]
    needs = [
        f"{device_text(name)}: rational distortion (k4 k5 k6): only recent releases of MATLAB take six radial terms"
        for name in rational
    ]
    return (*losses(rig, names, "MATLAB"), *needs)


def _to_struct(camera: Camera, subject: str) -> dict[str, Any]:
    prism = [name for name, value in zip(DISTORTION[8:], camera.distortion[8:], strict=True) if value != 0]
    if prism:
        raise InputError(subject, f"has distortion {', '.join(prism)}", "radial and tangential terms only, as MATLAB")
    k1, k2, p1, p2, *more = camera.distortion[:8]
    radial = [k1, k2, *more]
    count = 2 if not any(more) else 3 if not any(more[1:]) else 6
    return {
        "RadialDistortion": np.array([radial[:count]]),
        "TangentialDistortion": np.array([[p1, p2]]),
        "ImageSize": np.array([camera.size_px[::-1]], float),
        "WorldUnits": "mm",
        "EstimateSkew": np.array([[camera.K[0, 1] != 0]]),
        "NumRadialDistortionCoefficients": float(count),
        "EstimateTangentialDistortion": np.array([[p1 != 0 or p2 != 0]]),
        # Releases before R2022b do not know K; the later ones still read this, and none takes both.
        "IntrinsicMatrix": (camera.K + ORIGIN).T,
    }
