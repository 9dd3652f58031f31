"""The TextureImage: a metric picture of a piece of surface, unrolled into the plane."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.surface import Surface
from planish.registration.texture.charts import Chart, ChartOptions, plan_charts
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
    points_sensor, normals_sensor : ndarray (h, w, 3) float32
        Point [mm] and unit normal of the surface.
    x_axis_sensor : ndarray (h, w, 3) float32
        Unit tangent of the surface along the picture's x; its y is x cross normal.
    source_px : ndarray (h, w, 2) float32
        Pixel (u, v) of the organising camera; NaN, as the three before, where there is no surface.
    """

    pitch_mm: float = field(metadata={"unit": "mm"})
    value: Map
    sigma: Map
    mask: NDArray[np.bool_]
    points_sensor: Map = field(metadata={"unit": "mm"})
    normals_sensor: Map
    x_axis_sensor: Map
    source_px: Map = field(metadata={"unit": "px"})

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
        maps = self.points_sensor, self.normals_sensor, self.x_axis_sensor, self.source_px
        points, normals, x, pixels = (self._interpolated(image, xy) for image in maps)
        with np.errstate(invalid="ignore"):
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            x -= normals * (x * normals).sum(1, keepdims=True)
            x /= np.linalg.norm(x, axis=1, keepdims=True)
        direction = np.cos(angle_rad)[:, None] * x + np.sin(angle_rad)[:, None] * np.cross(x, normals)
        return points, np.stack([direction, np.cross(normals, direction), normals], axis=2), pixels

    def _interpolated(self, image: Map, xy: Array) -> Array:
        height, width = self.mask.shape
        corner = np.clip(np.floor(xy).astype(int), 0, [max(0, width - 2), max(0, height - 2)])
        far = np.minimum(corner + 1, [width - 1, height - 1])
        share = xy - corner
        inside: NDArray[np.bool_] = np.all((xy >= 0) & (xy <= [width - 1, height - 1]), axis=1)
        out = np.zeros((len(xy), image.shape[2]))
        for column, wx in ((corner[:, 0], 1 - share[:, 0]), (far[:, 0], share[:, 0])):
            for row, wy in ((corner[:, 1], 1 - share[:, 1]), (far[:, 1], share[:, 1])):
                out += (wx * wy)[:, None] * image[row, column]
                inside &= self.mask[row, column]
        return np.where(inside[:, None], out, np.nan)


def texture_images(
    measurement: Measurement,
    surface: Surface,
    contrast: tuple[Map, Map],
    pitch_mm: float,
    options: ChartOptions | None = None,
    threads: int | None = None,
) -> tuple[TextureImage, ...]:
    """Return one TextureImage per chart of the measurement; `contrast` is value and sigma from `local_contrast`."""
    charts = plan_charts(measurement, surface, options)
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
    places, extent = _core.chart_coordinates(surface.points_sensor, chart.maps, chart.step_px, max_height, threads)
    left, top, right, bottom = extent
    if not right >= left:
        return None
    width, height = (int(np.ceil(size / pitch_mm)) + 1 for size in (right - left, bottom - top))
    source = _core.rasterise_chart(places, left, top, pitch_mm, _MAX_EDGE_GSD * gsd_mm, height, width, threads)
    points, normals, x_axis = _core.chart_surface(
        source, surface.points_sensor, surface.normals_sensor, chart.maps, chart.step_px, threads
    )
    interpolated = _INTERPOLATED_SHARE if len(measurement.texture_views) > 1 else 0.0
    value, sigma = _core.sample_chart(*contrast, source, interpolated, threads)
    # NaN in a sum is NaN in one of its terms.
    mask = np.isfinite(value + sigma + points[..., 2] + normals[..., 2])
    return TextureImage(
        pitch_mm, np.where(mask, value, np.float32(0)), np.where(mask, sigma, np.float32(0)), mask, points, normals,
        x_axis, source,
    )  # fmt: skip
