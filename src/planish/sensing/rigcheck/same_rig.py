"""Measurements that are judged together must have one rig, whatever frame it is stated in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from planish.errors import InputError
from planish.geometry import invert, transform_points
from planish.measurement import Measurement
from planish.rig import Rig
from planish.sensing.rigcheck.pairs import PixelPairs

#: Relative difference of two rigs' numbers that is rounding of files and of a change of the frame.
SAME_RIG = 1e-7


def common_rig(measurements: Mapping[str, Measurement]) -> Rig:
    """Return the rig of the first measurement, after a check that it is that of all.

    Parameters
    ----------
    measurements : mapping of Measurement
        By the name of their files.

    Raises
    ------
    InputError
        Where rigs differ, names both files.
    """
    (first, reference), *others = measurements.items()
    for name, measurement in others:
        fault = _difference(reference.rig, measurement.rig)
        if fault:
            raise InputError(name, f"its rig is not that of {first} ({fault} differs)", "measurements of one rig")
    return reference.rig


def _difference(a: Rig, b: Rig) -> str:
    """Return what differs between two rigs but for their frames; empty where nothing does."""
    a, b = a.in_frame_of("A"), b.in_frame_of("A")
    if a.devices.keys() != b.devices.keys():
        return "the number of devices"
    for name in a.devices:
        left, right = a.devices[name], b.devices[name]
        for field in ("K", "distortion", "size_px", "T_camera_sensor"):
            x, y = np.asarray(getattr(left, field), float), np.asarray(getattr(right, field), float)
            if np.abs(x - y).max() > SAME_RIG * max(float(np.abs(x).max()), 1.0):
                return f"{name}.{field}"
    if (a.covariance is None) != (b.covariance is None):
        return "the covariance"
    if a.covariance is not None and b.covariance is not None:
        scale = np.sqrt(np.abs(np.diag(a.covariance)))
        limit = SAME_RIG * np.maximum(np.outer(scale, scale), 1e-300)
        if a.covariance_parameters != b.covariance_parameters or (np.abs(a.covariance - b.covariance) > limit).any():
            return "the covariance"
    return ""


def in_frame(pairs: PixelPairs, of: Rig, to: Rig) -> PixelPairs:
    """Return pairs of a measurement with the rig `of` with their points in the sensor frame of `to`."""
    T = invert(to.cameras["A"].T_camera_sensor) @ of.cameras["A"].T_camera_sensor
    return replace(pairs, points_sensor=np.asarray(transform_points(T, pairs.points_sensor), float))
