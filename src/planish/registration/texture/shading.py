"""What the known geometry says about brightness: the projector's light on a matt surface."""

from __future__ import annotations

import cv2
import numpy as np

from planish.measurement import Map, Measurement
from planish.registration.surface import Surface
from planish.registration.tiles import ground_sample_distance

#: Light that grazes the surface more than this is not predicted any more (cosine of the incidence).
_MIN_COSINE = 0.05


def projector_shading(measurement: Measurement, surface: Surface, normal_mm: float = 3.0) -> Map | None:
    """Return the projector's irradiance (H, W) on the surface up to a factor, or None where there is no projector.

    cos(incidence) / distance^2 for a point source (Lambert's law); NaN where there is no surface. Normals are averaged
    over `normal_mm` [mm].
    """
    projector = measurement.rig.projector
    if projector is None:
        return None
    centre = projector.center_sensor.astype(np.float32)
    to_light = centre - surface.points_sensor
    squared = np.einsum("hwi,hwi->hw", to_light, to_light)
    normals = _averaged(surface.normals_sensor, max(1, round(normal_mm / ground_sample_distance(measurement))))
    cosine = np.einsum("hwi,hwi->hw", normals, to_light) / np.sqrt(squared)
    # The distances are taken relative to a typical one, so that the values are near 1.
    typical = float(np.linalg.norm(centre - _middle(surface)))
    return np.maximum(cosine, np.float32(_MIN_COSINE)) * np.float32(typical**2) / squared


def _averaged(normals: Map, size_px: int) -> Map:
    known = np.isfinite(normals[..., 0])
    total = cv2.blur(np.where(known[..., None], normals, np.float32(0)), (size_px, size_px))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = total / np.linalg.norm(total, axis=2, keepdims=True)
    return np.where(known[..., None], unit, np.float32(np.nan))


def _middle(surface: Surface) -> Map:
    points = surface.points_sensor[::16, ::16].reshape(-1, 3)
    known = points[np.isfinite(points[:, 2])]
    return known.mean(0) if len(known) else np.zeros(3, np.float32)
