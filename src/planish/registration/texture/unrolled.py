"""The surface under a texture image, looked up where it is asked for: a map of it would be larger than the image."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from planish import _core
from planish.measurement import Map


@dataclass(frozen=True)
class UnrolledSurface:
    """A measurement's smoothed surface and the nodes of the chart that unrolls it.

    Parameters
    ----------
    points_sensor, normals_sensor : ndarray (H, W, 3) float32
        Point [mm] and unit normal at the pixels of the organising camera; NaN where there is no surface.
    nodes : ndarray (rows, columns, 13) float32
        Maps of the `Chart`.
    step_px : int
        Distance of the nodes.
    """

    points_sensor: Map = field(metadata={"unit": "mm"})
    normals_sensor: Map
    nodes: Map
    step_px: int = field(metadata={"unit": "px"})

    def at(self, pixels: Map) -> tuple[Map, Map, Map]:
        """Return what the surface is at pixels (..., 2) of the organising camera, interpolated between them.

        Returns
        -------
        points_sensor, normals_sensor : ndarray (..., 3) float32
            Point [mm] and unit normal; NaN where one of the four pixels around holds no surface.
        x_axis_sensor : ndarray (..., 3) float32
            Unit tangent of the surface along the chart's x; its y is x cross normal.
        """
        places = np.ascontiguousarray(pixels, np.float32)
        maps = self.points_sensor, self.normals_sensor, self.nodes
        points, normals, x_axis = _core.chart_surface(places.reshape(1, -1, 2), *maps, self.step_px, 1)
        shape = (*places.shape[:-1], 3)
        return points.reshape(shape), normals.reshape(shape), x_axis.reshape(shape)
