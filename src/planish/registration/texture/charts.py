"""Charts: plane frames from which a surface can be seen without too much foreshortening."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from planish.geometry import Array, plane_frame
from planish.measurement import Measurement
from planish.options import Options
from planish.registration.surface import Surface


class ChartOptions(Options):
    """Options of the charts."""

    #: One chart serves all normals within this angle of its axis [deg].
    core_deg: float = Field(default=30.0, gt=0, lt=80)
    #: A chart reaches beyond its core, so that charts overlap [deg].
    reach_deg: float = Field(default=42.0, gt=0, lt=85)
    #: Share of the surface that may stay without a chart.
    uncovered: float = Field(default=0.03, ge=0, lt=1)
    #: Largest number of charts.
    max_charts: int = Field(default=6, ge=1)


#: Every n-th pixel along both axes decides about the charts.
_STRIDE = 8


def plan_charts(measurement: Measurement, surface: Surface, options: ChartOptions | None = None) -> tuple[Array, ...]:
    """Return T_chart_sensor (4, 4) of each chart: x along the image's rows, y down, z into the surface.

    The first axis is the mean normal; while too much of the surface lies outside the cores, another chart is laid on
    the normal that covers most of the rest. The origin is the least corner of what the chart holds. Flat parts get one
    chart.
    """
    options = options or ChartOptions()
    points = surface.points_sensor[::_STRIDE, ::_STRIDE].reshape(-1, 3).astype(float)
    normals = surface.normals_sensor[::_STRIDE, ::_STRIDE].reshape(-1, 3).astype(float)
    known = np.isfinite(normals[:, 0])
    points, normals = points[known], normals[known]
    if len(points) == 0:
        return ()
    core, reach = np.cos(np.deg2rad([options.core_deg, options.reach_deg]))
    axes, left = [_unit(normals.mean(0))], np.ones(len(normals), bool)
    while True:
        left &= normals @ axes[-1] < core
        if left.sum() <= options.uncovered * len(normals) or len(axes) == options.max_charts:
            break
        candidates = normals[left][:: max(1, int(left.sum()) // 200)]
        covered = (normals[left] @ candidates.T >= core).sum(0)
        axes.append(_unit(normals[left][normals[left] @ candidates[np.argmax(covered)] >= core].mean(0)))
    x_hint = measurement.camera.T_camera_sensor[0, :3]
    charts = []
    for axis in axes:
        held = points[normals @ axis >= reach]
        if len(held) < 9:
            continue
        T = plane_frame(np.zeros(3), -axis, x_hint)
        T[:3, 3] = -np.min(held @ T[:3, :3].T, axis=0)
        charts.append(T)
    return tuple(charts)


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)
