"""The smoothed surface of a measurement on its own pixel grid: points, normals and tangents from local plane fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from planish import _core
from planish.measurement import Map, Measurement
from planish.options import Options, thread_count


class SurfaceOptions(Options):
    """Options of the local plane fit."""

    #: Half the window [px].
    radius_px: int = Field(default=3, ge=1, le=50)
    #: Largest change of depth per change of position that still counts as one surface (4 = 76 degrees).
    max_slope: float = Field(default=4.0, gt=0)


@dataclass(frozen=True)
class Surface:
    """Local plane fit around each pixel of the organising camera; NaN where there is no surface.

    Parameters
    ----------
    points_sensor : ndarray (H, W, 3) float32
        Point of the fitted plane on the pixel's own ray [mm].
    normals_sensor : ndarray (H, W, 3) float32
        Unit normal towards the sensor.
    tangents_sensor : ndarray (H, W, 6) float32
        Change of the point along u and along v [mm per pixel].
    """

    points_sensor: Map
    normals_sensor: Map
    tangents_sensor: Map


def fit_surface(measurement: Measurement, options: SurfaceOptions | None = None, threads: int | None = None) -> Surface:
    """Return the smoothed surface (linear fit of inverse depth, in which planes are exact)."""
    options = options or SurfaceOptions()
    points = np.ascontiguousarray(measurement.points_sensor, np.float32)
    parameters = measurement.camera.kernel_parameters
    return Surface(*_core.fit_surface(points, parameters, options.radius_px, options.max_slope, thread_count(threads)))
