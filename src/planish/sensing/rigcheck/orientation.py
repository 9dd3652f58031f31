"""The relative orientation of two devices: its five changes that row errors can show, and what they are called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from planish.geometry import Array, invert
from planish.rig import Rig
from planish.rig.parameters import EXTERNAL, PROJECTOR

#: Changes of the relative orientation [rad] in the order of `orientation_basis`. Turns act about the device's own
#: centre; the two others turn the direction of the baseline.
CHANGES = ("turn about the baseline", "roll about the view", "convergence", "offset across", "offset along the view")


def moved_device(own: str, other: str) -> tuple[str, str]:
    """Return the device whose orientation is in question, and the one that it stands against."""
    if PROJECTOR in (own, other):
        return PROJECTOR, own if other == PROJECTOR else other
    moved, fixed = sorted((own, other), reverse=True)
    return moved, fixed


def external_names(device: str) -> tuple[str, ...]:
    """Return the names of the external parameters of a device."""
    return tuple(f"{device}.{name}" for name in EXTERNAL)


def orientation_basis(rig: Rig, moved: str, fixed: str) -> Array:
    """Return the matrix (6, 5) from CHANGES [rad] to the external parameters of `moved`; the baseline keeps its length.

    Notes
    -----
    With the baseline t from device to device in the frame of `moved`, its view z and y = z x t: rotations about t, z
    and y, translations |t| y and |t| z, all orthogonal to t.
    """
    t = _baseline(rig, moved, fixed)
    length = float(np.linalg.norm(t))
    x = t / length
    z = np.array([0.0, 0.0, 1.0]) - x[2] * x
    # A device that looks along the baseline has no row errors to speak of; any direction serves there.
    z = z / np.linalg.norm(z) if np.linalg.norm(z) > 1e-6 else np.linalg.svd(x[None])[2][2]
    y = np.cross(z, x)
    basis = np.zeros((6, 5))
    basis[:3, 0], basis[:3, 1], basis[:3, 2] = x, z, y
    basis[3:, 3], basis[3:, 4] = length * y, length * z
    return basis


def without_baseline_length(rig: Rig, moved: str, fixed: str) -> Array:
    """Return the projection (6, 6) of external parameters of `moved` that takes out changes of the baseline's length.

    Its length is that of T_moved_fixed = Exp(xi) T: t + omega x t + tau, so only tau along t counts.
    """
    x = _baseline(rig, moved, fixed)
    x = x / np.linalg.norm(x)
    projection = np.eye(6)
    projection[3:, 3:] -= np.outer(x, x)
    return projection


def reoriented(rig: Rig, moved: str, fixed: str, change: ArrayLike) -> Rig:
    """Return the rig with the external parameters of `moved` changed (6,) [rad, mm], its baseline as long as before."""
    length = float(np.linalg.norm(_baseline(rig, moved, fixed)))
    changed = rig.changed(change, external_names(moved))
    device, against = changed.devices[moved], changed.devices[fixed]
    T = device.T_camera_sensor @ invert(against.T_camera_sensor)
    T[:3, 3] *= length / np.linalg.norm(T[:3, 3])
    device = replace(device, T_camera_sensor=T @ against.T_camera_sensor)
    if moved == PROJECTOR:
        return replace(changed, projector=device)
    return replace(changed, cameras={**changed.cameras, moved: device})


def _baseline(rig: Rig, moved: str, fixed: str) -> Array:
    devices = rig.devices
    T = devices[moved].T_camera_sensor @ invert(devices[fixed].T_camera_sensor)
    return np.asarray(T[:3, 3])


def with_names(names: Sequence[str], more: Sequence[str]) -> tuple[str, ...]:
    """Return names, and after them those of `more` that are not among them."""
    return (*names, *(name for name in more if name not in names))
