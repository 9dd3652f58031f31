"""What the known geometry says about brightness: the projector's light on a matt surface."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from planish import _core
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
    centre = projector.center_sensor
    points, normals = (lowpass.centres(maps) for maps in (surface.points_sensor, surface.normals_sensor))
    filled = np.nan_to_num(normals)
    block_mm = ground_sample_distance(measurement) * lowpass.factor
    return [_core.lambert(points, _averaged(filled, length / block_mm), centre, _MIN_COSINE) for length in lengths_mm]


def _averaged(normals: Map, size_blocks: float) -> Map:
    """Return sums of normals, 0 where unknown, over a window of `size_blocks`, which may be a fraction."""
    # A box of the same variance as a Gaussian.
    return cv2.GaussianBlur(normals, (0, 0), max(size_blocks, 1.0) / np.sqrt(12.0))
