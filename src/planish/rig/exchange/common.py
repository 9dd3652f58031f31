"""What the files of other programs have in common: what was read and converted, what is written and what is lost."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from planish.errors import InputError
from planish.geometry import Array, invert
from planish.rig.camera import Camera
from planish.rig.parameters import PROJECTOR
from planish.rig.rig import Rig

#: (width, height) [px].
Size = tuple[int, int]


class ImportedRig(NamedTuple):
    """A rig from a file.

    Parameters
    ----------
    rig : Rig
        The rig; from files of other programs in the frame of camera A.
    format : str
        Whose file it was.
    notes : tuple of str
        What was converted on the way, and what the user should know of the file.
    """

    rig: Rig
    format: Literal["planish", "OpenCV", "MATLAB"]
    notes: tuple[str, ...] = ()


def to_size(width_height: Array) -> Size | None:
    """Return the two numbers of an array of any shape as a size, or None where they are none."""
    numbers = np.ravel(width_height)
    if numbers.size != 2 or not np.isfinite(numbers).all() or numbers.min() < 1:
        return None
    return int(numbers[0]), int(numbers[1])


def size_of(name: str, found: Size | None, given: Size | None, subject: str, option: str) -> Size:
    """Return the size of a device that its file tells or the caller gives.

    Raises
    ------
    InputError
        Where there is none, or where both differ.
    """
    if found is not None and given is not None and found != given:
        raise InputError(
            f"{subject}: {name}",
            f"calibrated with {found[0]} x {found[1]} px",
            f"{given[0]} x {given[1]} px, the size in use",
        )
    size = found or given
    if size is None:
        raise InputError(f"{subject}: {name}", "its size is not in the calibration", option)
    return size


def devices_to_write(rig: Rig, devices: Sequence[str] | None, subject: str | Path, allowed: str) -> tuple[str, ...]:
    """Return the names of the one or two devices that a file can hold: the named ones, or all.

    Raises
    ------
    InputError
        Where the rig has no such device, where there are more than two, or where the first one is the projector.
    """
    chosen = tuple(rig.devices if devices is None else devices)
    unknown = [name for name in chosen if name not in rig.devices]
    if unknown or len(set(chosen)) != len(chosen) or not chosen or chosen[0] == PROJECTOR or len(chosen) > 2:
        raise InputError(
            f"{subject}: devices",
            f"found {', '.join(chosen) or 'none'}; the rig has {', '.join(rig.devices)}",
            f"{allowed} (devices, --devices)",
        )
    return chosen


def relative_transform(rig: Rig, first: str, second: str) -> Array:
    """Return T_second_first (4, 4): x_second = T x_first [mm]."""
    devices = rig.devices
    return np.asarray(devices[second].T_camera_sensor @ invert(devices[first].T_camera_sensor))


def losses(rig: Rig, written: Sequence[str], program: str) -> tuple[str, ...]:
    """Return, in words, what of the rig a file with the devices `written` does not hold."""
    notes = []
    left = [name for name in rig.devices if name not in written]
    if left:
        notes.append(f"not in the file: {', '.join(left)}")
    if rig.covariance is not None:
        count = len(rig.covariance_parameters)
        notes.append(f"not in the file: the covariance of {count} parameters, for which {program} has no place")
    if not np.array_equal(rig.devices[written[0]].T_camera_sensor, np.eye(4)):
        notes.append(f"not in the file: the sensor frame; its place takes that of {device_text(written[0])}")
    return tuple(notes)


def device_text(name: str) -> str:
    """Return "camera A" or "projector"."""
    return name if name == PROJECTOR else f"camera {name}"


def used_coefficients(camera: Camera, lengths: Sequence[int]) -> Array:
    """Return the distortion cut to the shortest of `lengths` that leaves no coefficient out."""
    used = np.flatnonzero(camera.distortion)
    last = used[-1] + 1 if len(used) else 0
    return camera.distortion[: next(length for length in lengths if length >= last)]
