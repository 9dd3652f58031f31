"""Places of a texture image on the surface, each with a local frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.geometry import Array
from planish.registration.texture.resample import TextureImage


@dataclass(frozen=True)
class SurfacePlaces:
    """N places of a texture image with an orientation.

    Parameters
    ----------
    xy : ndarray (N, 2)
        Column and row [texture px].
    angle : ndarray (N,)
        Orientation in the chart, from its x axis towards y [rad].
    frames_sensor : ndarray (N, 3, 3)
        Columns: orientation in the tangent plane, normal x orientation, normal.
    points_sensor : ndarray (N, 3)
        Position [mm].
    source_px : ndarray (N, 2)
        Pixel (u, v) of the organising camera.
    """

    xy: Array
    angle: Array
    frames_sensor: Array
    points_sensor: Array
    source_px: Array

    def __len__(self) -> int:
        return len(self.xy)


def places_on_surface(image: TextureImage, xy: Array, angle: Array) -> SurfacePlaces:
    """Return the places (N, 2) that lie on the surface, with their orientations (N,) [rad] and frames.

    A place that cannot be interpolated stands at the rim of the surface and is left out.
    """
    points, frames, pixels = image.locate(xy, angle)
    known = np.isfinite(points[:, 0])
    return SurfacePlaces(xy[known], angle[known], frames[known], points[known], pixels[known])
