"""What the known geometry says about brightness: the projector's light on a matt surface."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from planish.measurement import Map, Measurement
from planish.registration.surface import Surface
from planish.registration.texture.lowpass import Lowpass
from planish.registration.tiles import ground_sample_distance

#: Light that grazes the surface more than this is not predicted any more (cosine of the incidence).
_MIN_COSINE = 0.05


def projector_shading(
    measurement: Measurement, surface: Surface, lowpass: Lowpass, lengths_mm: Sequence[float]
) -> list[Map]:
    """Return the projector's irradiance (h, w) at the blocks of a low-pass, once per length of `lengths_mm`.

    cos(incidence) / distance^2 for a point source (Lambert's law), up to a factor; NaN where there is no surface.
    Normals are averaged over the length [mm].
    """
    projector = measurement.rig.projector
    assert projector is not None, "shading needs a projector"
    points, normals = (lowpass.centres(maps) for maps in (surface.points_sensor, surface.normals_sensor))
    centre = projector.center_sensor.astype(np.float32)
    to_light = centre - points
    squared = np.einsum("hwi,hwi->hw", to_light, to_light)
    # The distances are taken relative to a typical one, so that the values are near 1.
    typical = np.float32(float(np.linalg.norm(centre - _middle(points))) ** 2)
    distance = np.sqrt(squared)
    known = np.isfinite(normals[..., :1])
    filled = np.where(known, normals, np.float32(0))
    shadings = []
    for length_mm in lengths_mm:
        size = length_mm / (ground_sample_distance(measurement) * lowpass.factor)
        averaged = np.where(known, _averaged(filled, size), np.float32(np.nan))
        cosine = np.einsum("hwi,hwi->hw", averaged, to_light) / distance
        shadings.append(np.maximum(cosine, np.float32(_MIN_COSINE)) * typical / squared)
    return shadings


def _averaged(normals: Map, size_blocks: float) -> Map:
    """Return unit normals, 0 where unknown, averaged over a window of `size_blocks`, which may be a fraction."""
    # A box of the same variance as a Gaussian.
    deviation = max(size_blocks, 1.0) / np.sqrt(12.0)
    total = cv2.GaussianBlur(normals, (0, 0), deviation)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(total / np.sqrt(np.einsum("hwi,hwi->hw", total, total))[..., None])


def _middle(points: Map) -> Map:
    known = points[np.isfinite(points[..., 2])]
    return known.mean(0) if len(known) else np.zeros(3, np.float32)
