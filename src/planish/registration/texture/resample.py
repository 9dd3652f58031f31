"""The TextureImage: a metric picture of a piece of surface, unrolled into the plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.surface import Surface
from planish.registration.texture.charts import Chart
from planish.registration.texture.periods import Period, find_period
from planish.registration.texture.unrolled import UnrolledSurface
from planish.registration.tiles import ground_sample_distance

#: Triangles with an edge longer than this many sample distances bridge a gap and are left out.
_MAX_EDGE_GSD = 6.0
#: Points farther from the tangent planes of the nodes around them than this share of the nodes' distance belong to
#: another surface (in the middle between nodes, that is a bend of 60 degrees).
_MAX_HEIGHT = 0.35
#: Share of the contrast's noise that comes from the camera that was read between its pixels: cubic convolution leaves
#: c = 0.81 of the variance per axis, and the better camera counts more: 1 / (1 + c^2).
_INTERPOLATED_SHARE = 0.6


@dataclass(frozen=True)
class TextureImage:
    """Picture of an unrolled piece of surface; pixel (column, row) stands at (column, row) * pitch_mm in the plane.

    x points right, y down, as the sensor sees the part; distances in the picture are distances along the surface.

    Parameters
    ----------
    pitch_mm : float
        Size of a pixel [mm].
    value : ndarray (h, w) float32
        Local contrast (relative albedo), 0 outside `mask`.
    sigma : ndarray (h, w) float32
        Standard deviation of `value` from camera noise.
    mask : ndarray (h, w) bool
        Where the chart holds surface and texture.
    source_px : ndarray (h, w, 2) float32
        Pixel (u, v) of the organising camera; NaN where there is no surface.
    surface : UnrolledSurface
        The surface at these pixels; its x axis is the picture's.
    """

    pitch_mm: float = field(metadata={"unit": "mm"})
    value: Map
    sigma: Map
    mask: NDArray[np.bool_]
    source_px: Map = field(metadata={"unit": "px"})
    surface: UnrolledSurface

    @cached_property
    def period(self) -> Period | None:
        """How the texture repeats in itself; None where it does not."""
        return find_period(self.value, self.sigma, self.mask, self.pitch_mm)

    def points_at(self, row: NDArray[np.integer], column: NDArray[np.integer]) -> Array:
        """Return the points (N, 3) of the surface [mm] at pixels of the picture; NaN where there are none."""
        return self.surface.at(self.source_px[row, column])[0].astype(float)

    def locate(self, xy: Array, angle_rad: Array) -> tuple[Array, Array, Array]:
        """Return where places of the picture lie on the part.

        Parameters
        ----------
        xy : ndarray (N, 2)
            Column and row [texture px].
        angle_rad : ndarray (N,)
            A direction in the picture, from x towards y.

        Returns
        -------
        points_sensor : ndarray (N, 3)
            Interpolated linearly [mm]; NaN, as all of the place, where one of the four pixels around it is not in the
            mask.
        frames_sensor : ndarray (N, 3, 3)
            Columns: the direction on the surface, normal x direction, normal.
        pixels : ndarray (N, 2)
            Pixel (u, v) of the organising camera.
        """
        pixels, points, normals, x = self._interpolated(xy)
        with np.errstate(invalid="ignore"):
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            x -= normals * (x * normals).sum(1, keepdims=True)
            x /= np.linalg.norm(x, axis=1, keepdims=True)
        direction = np.cos(angle_rad)[:, None] * x + np.sin(angle_rad)[:, None] * np.cross(x, normals)
        return points, np.stack([direction, np.cross(normals, direction), normals], axis=2), pixels

    def _interpolated(self, xy: Array) -> tuple[Array, ...]:
        """Camera pixels (N, 2), points, normals and x axes (N, 3) between the four pixels around each place."""
        height, width = self.mask.shape
        corner = np.clip(np.floor(xy).astype(int), 0, [max(0, width - 2), max(0, height - 2)])
        far = np.minimum(corner + 1, [width - 1, height - 1])
        share = xy - corner
        columns = np.stack([corner[:, 0], corner[:, 0], far[:, 0], far[:, 0]])
        rows = np.stack([corner[:, 1], far[:, 1], corner[:, 1], far[:, 1]])
        x, y = share.T
        weights = np.stack([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y])[..., None]
        inside = np.all((xy >= 0) & (xy <= [width - 1, height - 1]), axis=1) & self.mask[rows, columns].all(0)
        source = self.source_px[rows, columns]
        means = ((weights * values).sum(0) for values in (source, *self.surface.at(source)))
        return tuple(np.where(inside[:, None], mean, np.nan) for mean in means)


def texture_images(
    measurement: Measurement,
    surface: Surface,
    contrast: tuple[Map, Map],
    pitch_mm: float,
    charts: Sequence[Chart],
    threads: int | None = None,
) -> tuple[TextureImage, ...]:
    """Return one TextureImage per chart of `plan_charts`; `contrast` is value and sigma from `local_contrast`."""
    count = thread_count(threads)
    drawn = (_resample(measurement, surface, contrast, chart, pitch_mm, count) for chart in charts)
    return tuple(image for image in drawn if image is not None)


def _resample(
    measurement: Measurement,
    surface: Surface,
    contrast: tuple[Map, Map],
    chart: Chart,
    pitch_mm: float,
    threads: int,
) -> TextureImage | None:
    gsd_mm = ground_sample_distance(measurement)
    max_height = _MAX_HEIGHT * chart.step_px * gsd_mm
    places, known, extent = _core.chart_coordinates(
        surface.points_sensor, chart.maps, chart.step_px, max_height, threads
    )
    left, top, right, bottom = extent
    if not right >= left:
        return None
    width, height = (int(np.ceil(size / pitch_mm)) + 1 for size in (right - left, bottom - top))
    source = _core.rasterise_chart(places, left, top, pitch_mm, _MAX_EDGE_GSD * gsd_mm, height, width, threads)
    interpolated = _INTERPOLATED_SHARE if len(measurement.texture_views) > 1 else 0.0
    value, sigma, mask = _core.sample_chart(*contrast, known, source, interpolated, threads)
    unrolled = UnrolledSurface(surface.points_sensor, surface.normals_sensor, chart.maps, chart.step_px)
    return TextureImage(pitch_mm, value, sigma, mask.view(np.bool_), source, unrolled)
