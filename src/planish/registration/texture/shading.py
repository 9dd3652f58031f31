"""What the known geometry says about brightness: the projector's light on a matt surface."""

from __future__ import annotations

import cv2
import numpy as np

from planish.measurement import Map, Measurement
from planish.registration.surface import Surface
from planish.registration.texture.lowpass import Lowpass
from planish.registration.tiles import ground_sample_distance

#: Light that grazes the surface more than this is not predicted any more (cosine of the incidence).
_MIN_COSINE = 0.05


def projector_shading(measurement: Measurement, surface: Surface, lowpass: Lowpass, normal_mm: float = 3.0) -> Map:
    """Return the projector's irradiance (h, w) at the blocks of a low-pass.

    cos(incidence) / distance^2 for a point source (Lambert's law), up to a factor; NaN where there is no surface.
    Normals are averaged over `normal_mm` [mm].
    """
    projector = measurement.rig.projector
    assert projector is not None, "shading needs a projector"
    points, normals = (lowpass.centres(maps) for maps in (surface.points_sensor, surface.normals_sensor))
    centre = projector.center_sensor.astype(np.float32)
    to_light = centre - points
    squared = np.einsum("hwi,hwi->hw", to_light, to_light)
    size = normal_mm / (ground_sample_distance(measurement) * lowpass.factor)
    cosine = np.einsum("hwi,hwi->hw", _averaged(normals, size), to_light) / np.sqrt(squared)
    # The distances are taken relative to a typical one, so that the values are near 1.
    typical = float(np.linalg.norm(centre - _middle(points)))
    return np.maximum(cosine, np.float32(_MIN_COSINE)) * np.float32(typical**2) / squared


def _averaged(normals: Map, size_blocks: float) -> Map:
    """Return unit normals averaged over a window of `size_blocks`, which may be a fraction."""
    known = np.isfinite(normals[..., 0])
    # A box of the same variance as a Gaussian.
    deviation = max(size_blocks, 1.0) / np.sqrt(12.0)
    total = cv2.GaussianBlur(np.where(known[..., None], normals, np.float32(0)), (0, 0), deviation)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = total / np.linalg.norm(total, axis=2, keepdims=True)
    return np.where(known[..., None], unit, np.float32(np.nan))


def _middle(points: Map) -> Map:
    known = points[np.isfinite(points[..., 2])]
    return known.mean(0) if len(known) else np.zeros(3, np.float32)
