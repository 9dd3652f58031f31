"""From the organising camera's grid to another camera's own one, and what each camera sees of the measured surface."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.measurement import Map, Measurement
from planish.registration.texture.lowpass import Lowpass


def surface_seen(measurement: Measurement, name: str, lowpass: Lowpass) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of a camera that show measured points; of another camera, whole blocks of them."""
    if name == measurement.organised_on:
        return measurement.valid
    width, height = measurement.rig.cameras[name].size_px
    factor = lowpass.factor
    hit = _core.mark_blocks(lowpass.centres(correspondence(measurement, name)), factor, height, width)
    # The samples lie a block apart, more where this camera sees the surface less obliquely: small holes are closed.
    hit = cv2.morphologyEx(hit, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    whole = cv2.resize(hit, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    return np.ascontiguousarray(whole[:height, :width]).view(np.bool_)


def from_camera_blocks(measurement: Measurement, name: str, maps: Sequence[Map], lowpass: Lowpass) -> tuple[Map, ...]:
    """Return blocks of a camera at the centres of the organising camera's blocks (h, w); NaN where unknown."""
    if name == measurement.organised_on:
        return tuple(maps)
    places = lowpass.centres(correspondence(measurement, name))
    places = (places + np.float32(0.5)) / np.float32(lowpass.factor) - np.float32(0.5)
    u, v = (np.nan_to_num(np.ascontiguousarray(places[..., i]), nan=-1e4) for i in (0, 1))
    constant, unknown = cv2.BORDER_CONSTANT, float("nan")
    return tuple(cv2.remap(blocks, u, v, cv2.INTER_LINEAR, borderMode=constant, borderValue=unknown) for blocks in maps)


def correspondence(measurement: Measurement, name: str) -> Map:
    """Return the pixel (H, W, 2) of another camera that corresponds to each of the organising one."""
    where = measurement.correspondence_px
    assert where is not None, f"texture of camera {name} needs the correspondence"
    return np.ascontiguousarray(where, np.float32)
