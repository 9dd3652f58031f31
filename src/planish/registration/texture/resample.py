"""The TextureImage: a metric, orthographic picture of a measurement on a chart."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array, transform_points
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.surface import Surface
from planish.registration.texture.charts import ChartOptions, plan_charts
from planish.registration.tiles import ground_sample_distance

#: Triangles with an edge longer than this many sample distances bridge a gap and are left out.
_MAX_EDGE_GSD = 6.0
#: Share of the contrast's noise that comes from the camera that was read between its pixels: cubic convolution leaves
#: c = 0.82 of the variance per axis, the better camera counts more: 1 / (1 + c^2).
_INTERPOLATED_SHARE = 0.6


@dataclass(frozen=True)
class TextureImage:
    """Orthographic picture of the surface; the centre of pixel (column, row) is (column, row) * pitch_mm in the chart.

    Parameters
    ----------
    T_chart_sensor : ndarray (4, 4)
        Chart axes: x right, y down, z into the surface [mm].
    pitch_mm : float
        Size of a pixel [mm].
    value : ndarray (h, w) float32
        Local contrast (relative albedo), 0 outside `mask`.
    sigma : ndarray (h, w) float32
        Standard deviation of `value` from camera noise.
    height_mm : ndarray (h, w) float32
        Surface z in the chart [mm]; NaN outside `mask`.
    normal_chart : ndarray (h, w, 3) float32
        Unit normals in the chart frame (z < 0: towards the sensor).
    mask : ndarray (h, w) bool
        Where the chart holds surface and texture.
    source_px : ndarray (h, w, 2) float32
        Pixel (u, v) of the organising camera.
    """

    T_chart_sensor: Array
    pitch_mm: float = field(metadata={"unit": "mm"})
    value: Map
    sigma: Map
    height_mm: Map = field(metadata={"unit": "mm"})
    normal_chart: Map
    mask: NDArray[np.bool_]
    source_px: Map = field(metadata={"unit": "px"})


def texture_images(
    measurement: Measurement,
    surface: Surface,
    contrast: tuple[Map, Map],
    pitch_mm: float,
    options: ChartOptions | None = None,
    threads: int | None = None,
) -> tuple[TextureImage, ...]:
    """Return one TextureImage per chart of the measurement; `contrast` is value and sigma from `local_contrast`."""
    options = options or ChartOptions()
    charts = plan_charts(measurement, surface, options)
    count = thread_count(threads)
    return tuple(_resample(measurement, surface, contrast, T, pitch_mm, options, count) for T in charts)


def _resample(
    measurement: Measurement,
    surface: Surface,
    contrast: tuple[Map, Map],
    T_chart_sensor: Array,
    pitch_mm: float,
    options: ChartOptions,
    threads: int,
) -> TextureImage:
    min_cosine = float(np.cos(np.deg2rad(options.reach_deg)))
    width, height = _chart_size(surface, T_chart_sensor, pitch_mm, min_cosine)
    max_edge = _MAX_EDGE_GSD * ground_sample_distance(measurement)
    source, z = _core.rasterise_chart(
        surface.points_sensor,
        surface.normals_sensor,
        T_chart_sensor,
        pitch_mm,
        min_cosine,
        max_edge,
        height,
        width,
        threads,
    )
    known = np.isfinite(z)
    interpolated = _INTERPOLATED_SHARE if len(measurement.texture_views) > 1 else 0.0
    sampled, sigma = _core.sample_chart(*contrast, source, interpolated, threads)
    u, v = (np.where(known, source[..., i], np.float32(-1e4)) for i in (0, 1))
    seen = cv2.remap(
        surface.normals_sensor, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(float("nan"),) * 3
    )
    normal = seen @ T_chart_sensor[:3, :3].T.astype(np.float32)
    mask = known & np.isfinite(sampled) & np.isfinite(normal[..., 0])
    return TextureImage(
        T_chart_sensor, pitch_mm, np.where(mask, sampled, np.float32(0)), np.where(mask, sigma, np.float32(0)),
        np.where(mask, z, np.float32(np.nan)), normal, mask, source,
    )  # fmt: skip


def _chart_size(surface: Surface, T_chart_sensor: Array, pitch_mm: float, min_cosine: float) -> tuple[int, int]:
    """Width and height [px] of what the chart holds; a rim that the sparse sampling misses is cut off."""
    points, normals = (m[::_EXTENT_STRIDE, ::_EXTENT_STRIDE] for m in (surface.points_sensor, surface.normals_sensor))
    faces = normals @ -T_chart_sensor[2, :3] >= min_cosine
    extent = np.max(transform_points(T_chart_sensor, points[faces]).astype(float), axis=0, initial=0.0)
    width, height = (int(n) + 1 for n in np.ceil(extent[:2] / pitch_mm))
    return width, height


#: Every n-th pixel decides about the size of a chart.
_EXTENT_STRIDE = 4
