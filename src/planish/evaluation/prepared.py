"""What the evaluation of a pair needs of each of its measurements, computed once per measurement and on demand."""

from __future__ import annotations

from functools import cached_property

from planish import _core
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.surface import Surface, fit_surface
from planish.registration.texture.photometric import local_contrast
from planish.registration.tiles import ground_sample_distance, tile_size_px


class Prepared:
    """A measurement with its local surface and its texture.

    Parameters
    ----------
    measurement : Measurement
        The measurement itself.
    surface : Surface or None
        Its local surface where it is known already.
    contrast : tuple of two ndarray (H, W) float32, or None
        Local contrast of its texture and the standard deviation, where they are known already.
    threads : int or None
        Number of threads for what is computed here.
    """

    def __init__(
        self,
        measurement: Measurement,
        surface: Surface | None = None,
        contrast: tuple[Map, Map] | None = None,
        threads: int | None = None,
    ) -> None:
        self.measurement, self._surface, self._contrast, self._threads = measurement, surface, contrast, threads

    @classmethod
    def of(cls, item: Measurement | Prepared, threads: int | None = None) -> Prepared:
        """Return `item` itself where it is prepared."""
        return item if isinstance(item, Prepared) else cls(item, threads=threads)

    @cached_property
    def surface(self) -> Surface:
        """Normals and tangents on the pixel grid; NaN where there is no surface."""
        return self._surface or fit_surface(self.measurement, threads=self._threads)

    @cached_property
    def contrast(self) -> tuple[Map, Map]:
        """Local contrast of the texture and its standard deviation, each (H, W) float32; NaN where unknown."""
        return self._contrast or local_contrast(self.measurement, surface=self.surface)

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
        return _core.pixel_areas(self.surface.tangents_sensor, thread_count(self._threads))

    @cached_property
    def area_mm2(self) -> float:
        """Area of the whole measured surface [mm^2]."""
        return float(self.areas_mm2.sum(dtype=float))
