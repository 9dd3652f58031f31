"""A surface under a texture image that is given at the pixels of its camera, which stand a whole pixel apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class GivenSurface:
    """Points, normals and x axes (H, W, 3); stands in for an `UnrolledSurface`."""

    points_sensor: np.ndarray
    normals_sensor: np.ndarray
    x_axis_sensor: np.ndarray

    def at(self, pixels):
        u, v = np.moveaxis(np.rint(pixels).astype(int), -1, 0)
        return self.points_sensor[v, u], self.normals_sensor[v, u], self.x_axis_sensor[v, u]
