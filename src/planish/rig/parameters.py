"""The numbers of a rig's calibration by name: what a covariance's rows stand for, and what becomes of them elsewhere.

A parameter is called "<device>.<name>": the device is "A", "B" or "projector", the name one of DEVICE_PARAMETERS.
Rotation [rad] and translation [mm] are xi of T_device_sensor = Exp(xi) T_hat: they act in the device's own frame, about
its projection centre.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from planish.errors import InputError
from planish.geometry import Array, adjoint, exp_se3, invert
from planish.rig.camera import Camera

INTRINSICS = ("fx", "fy", "cx", "cy", "skew")
#: OpenCV's order.
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
EXTERNAL = ("rotation_x", "rotation_y", "rotation_z", "translation_x", "translation_y", "translation_z")
#: All parameters of one device, in the order of `change_camera` and of `planish.rig.derivatives`.
DEVICE_PARAMETERS = INTRINSICS + DISTORTION + EXTERNAL
#: Where the external ones stand in it.
EXTERNAL_PART = slice(len(INTRINSICS) + len(DISTORTION), len(DEVICE_PARAMETERS))
PROJECTOR = "projector"
#: Share of the variances that make up another one below which it is their rounding.
CANCELLED = 1e-13


def split_name(name: str, devices: Sequence[str], subject: str = "covariance parameters") -> tuple[str, int]:
    """Return device and place in DEVICE_PARAMETERS of "A.fx".

    Raises
    ------
    InputError
        Where the rig has no such device, or a device no such parameter.
    """
    device, _, parameter = name.partition(".")
    if device not in devices or parameter not in DEVICE_PARAMETERS:
        raise InputError(
            subject,
            f"found '{name}'",
            f"<device>.<parameter>: devices {', '.join(devices)}, parameters {', '.join(DEVICE_PARAMETERS)}",
        )
    return device, DEVICE_PARAMETERS.index(parameter)


def selection(names: Sequence[str], devices: Sequence[str]) -> dict[str, Array]:
    """Return per device the matrix (23, n) that picks the n named parameters' values into its DEVICE_PARAMETERS."""
    picks = {device: np.zeros((len(DEVICE_PARAMETERS), len(names))) for device in devices}
    for column, name in enumerate(names):
        device, place = split_name(name, devices)
        picks[device][place, column] = 1.0
    return picks


def change_camera(camera: Camera, change: Array) -> Camera:
    """Return the camera with its DEVICE_PARAMETERS changed by `change` (23,) [px, 1, rad, mm]."""
    K = camera.K.copy()
    K[[0, 1, 0, 1, 0], [0, 1, 2, 2, 1]] += change[: len(INTRINSICS)]
    return replace(
        camera,
        K=K,
        distortion=camera.distortion + change[len(INTRINSICS) : EXTERNAL_PART.start],
        T_camera_sensor=exp_se3(change[EXTERNAL_PART]) @ camera.T_camera_sensor,
    )


def covariance_in_frame(
    covariance: Array, names: Sequence[str], T_device_sensor: Mapping[str, Array], new: str
) -> tuple[Array, tuple[str, ...]]:
    """Return covariance and names after the frame of the device `new` became the sensor frame.

    Parameters
    ----------
    covariance : ndarray (n, n)
        Of the named parameters.
    names : sequence of str
        Their names.
    T_device_sensor : mapping of ndarray (4, 4)
        Per device, with the old sensor frame.
    new : str
        Device whose frame the sensor frame becomes: it has no external parameters then.

    Notes
    -----
    T_i_new = Exp(xi_i) T_i_s (Exp(xi_new) T_new_s)^-1 = Exp(xi_i) T Exp(-xi_new), T = T_i_s T_s_new, to first order
    Exp(xi_i - Ad(T) xi_new) T.
    """
    devices = tuple(T_device_sensor)
    picks = selection(names, devices)
    external = [f"{device}.{name}" for device in devices if device != new for name in EXTERNAL]
    kept = [name for name in names if name.partition(".")[2] not in EXTERNAL]
    rows = [np.eye(len(names))[list(names).index(name)] for name in kept]
    for device in devices:
        if device != new:
            T = T_device_sensor[device] @ invert(T_device_sensor[new])
            rows += list(picks[device][EXTERNAL_PART] - adjoint(T) @ picks[new][EXTERNAL_PART])
    J = np.array(rows).reshape(-1, len(names))
    order = sorted(range(len(J)), key=lambda i: _place([*kept, *external][i], devices))
    J = J[order]
    moved = J @ covariance @ J.T
    # What the devices have in common falls out; where nothing else is left, rounding is, of either sign.
    exact = np.diag(moved) <= CANCELLED * np.diag(np.abs(J) @ np.abs(covariance) @ np.abs(J).T)
    moved[exact] = moved[:, exact] = 0.0
    ordered = tuple([*kept, *external][i] for i in order)
    # A device that the old covariance left exact may still be: rows of zeros say nothing.
    used = [i for i, name in enumerate(ordered) if name in names or moved[i, i] > 0]
    return moved[np.ix_(used, used)], tuple(ordered[i] for i in used)


def _place(name: str, devices: Sequence[str]) -> tuple[int, int]:
    device, place = split_name(name, devices)
    return devices.index(device), place
