"""What the evaluation of a pair needs of each of its measurements, computed once per measurement."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from planish.measurement import Map, Measurement
from planish.registration.surface import Surface, fit_surface
from planish.registration.texture.photometric import local_contrast
from planish.registration.tiles import ground_sample_distance, tile_size_px


@dataclass(frozen=True)
class Prepared:
    """A measurement with its local surface and its texture.

    Parameters
    ----------
    measurement : Measurement
        The measurement itself.
    surface : Surface
        Normals and tangents on its pixel grid.
    contrast : ndarray (H, W) float32
        Local contrast of the texture; NaN where unknown.
    contrast_sigma : ndarray (H, W) float32
        Its standard deviation.
    """

    measurement: Measurement
    surface: Surface
    contrast: Map
    contrast_sigma: Map

    @cached_property
    def gsd_mm(self) -> float:
        """Ground sample distance [mm per pixel]."""
        return ground_sample_distance(self.measurement)

    @cached_property
    def tile_size_px(self) -> int:
        """Edge of a tile on the pixel grid [px]."""
        return tile_size_px(self.measurement)

    @cached_property
    def areas_mm2(self) -> Map:
        """Area of the surface that each pixel covers (H, W) [mm^2]; 0 where there is no surface."""
        tangents = self.surface.tangents_sensor
        u, v = tangents[..., :3], tangents[..., 3:]
        # |u x v| by Lagrange's identity: cheaper than the cross product of whole images.
        uv = np.einsum("hwi,hwi->hw", u, v)
        squared = np.einsum("hwi,hwi->hw", u, u) * np.einsum("hwi,hwi->hw", v, v) - uv * uv
        return np.sqrt(np.nan_to_num(squared, nan=0.0).clip(min=0.0))


def prepare(measurement: Measurement, surface: Surface | None = None, threads: int | None = None) -> Prepared:
    """Return `measurement` with its surface (computed unless given) and its texture."""
    value, sigma = local_contrast(measurement)
    return Prepared(measurement, surface or fit_surface(measurement, threads=threads), value, sigma)
