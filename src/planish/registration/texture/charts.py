"""Charts: pieces of a surface, each unrolled into a plane."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import Field

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.options import Options
from planish.registration.surface import Surface
from planish.registration.texture.develop import Nodes, surface_nodes, unroll


class ChartOptions(Options):
    """Options of the charts."""

    #: Nodes along the longer side of the image, between which the unrolled surface is interpolated to third order.
    nodes: int = Field(default=64, ge=4, le=512)
    #: A piece that cannot be unrolled without changing lengths by more than this (double curvature) is split ...
    max_strain: float = Field(default=0.05, gt=0, lt=1)
    #: ... unless this share of it is concerned; so much may also stay without a chart.
    uncovered: float = Field(default=0.03, ge=0, lt=1)
    #: A part of what is split serves all normals within this angle of its axis [deg] ...
    core_deg: float = Field(default=30.0, gt=0, lt=80)
    #: ... and reaches beyond, so that parts overlap [deg].
    reach_deg: float = Field(default=42.0, gt=0, lt=85)
    #: Smallest share of the surface that makes a chart.
    min_share: float = Field(default=0.01, ge=0, lt=1)
    #: Largest number of charts.
    max_charts: int = Field(default=6, ge=1)


@dataclass(frozen=True)
class Chart:
    """A piece of the surface and its coordinates in the plane: x right, y down as the sensor sees it.

    Near a node, a point X has the coordinates (x, y, height) = axes @ X + offsets; between nodes, axes and offsets are
    interpolated.

    Parameters
    ----------
    step_px : int
        Distance of the nodes along rows and columns; node (0, 0) is pixel (step_px // 2, step_px // 2).
    maps : ndarray (rows, columns, 13) float32
        Per node: 1, x axis (3), y axis (3), normal (3), offsets of x, y and height [mm]; all 0 where the chart has no
        node.
    strain : float
        Relative change of length that 95 % of the piece stay below.
    """

    step_px: int
    maps: Map
    strain: float


def plan_charts(measurement: Measurement, surface: Surface, options: ChartOptions | None = None) -> tuple[Chart, ...]:
    """Return the charts of a measurement, the largest first.

    Each piece of surface that hangs together is one chart: flat, bent and rolled parts alike. Only what has too much
    double curvature is split into overlapping parts by its normals.
    """
    options = options or ChartOptions()
    nodes = surface_nodes(surface, max(1, round(max(measurement.shape) / options.nodes)))
    smallest = max(3, round(options.min_share * len(nodes.index)))
    x_hint = measurement.camera.T_camera_sensor[0, :3]
    charts = []
    for piece in nodes.pieces(smallest):
        whole = unroll(piece, x_hint)
        if np.mean(np.abs(whole[2]) > options.max_strain) <= options.uncovered:
            charts.append(_chart(piece, *whole))
            continue
        parts = (part for cone in _split(piece.normals, options) for part in piece.take(cone).pieces(smallest))
        charts.extend(_chart(part, *unroll(part, x_hint)) for part in parts)
    return tuple(charts[: options.max_charts])


def _split(normals: Array, options: ChartOptions) -> list[np.ndarray]:
    """Return overlapping sets of nodes with similar normals that leave hardly any out.

    The first axis is the mean normal; while too much lies outside the cores, another is laid on the normal whose core
    covers most of the rest.
    """
    core, reach = np.cos(np.deg2rad([options.core_deg, options.reach_deg]))
    axes, left = [_unit(normals.mean(0))], np.ones(len(normals), bool)
    while True:
        left &= normals @ axes[-1] < core
        if left.sum() <= options.uncovered * len(normals) or len(axes) == options.max_charts:
            break
        candidates = normals[left][:: max(1, int(left.sum()) // 200)]
        covered = (normals[left] @ candidates.T >= core).sum(0)
        axes.append(_unit(normals[left][normals[left] @ candidates[np.argmax(covered)] >= core].mean(0)))
    return [np.flatnonzero(normals @ axis >= reach) for axis in axes]


def _chart(nodes: Nodes, coordinates: Array, axes: Array, strain: Array) -> Chart:
    frames = np.concatenate([axes, nodes.normals[:, None]], 1)
    places = np.column_stack([coordinates, np.zeros(len(coordinates))])
    offsets = places - np.einsum("nki,ni->nk", frames, nodes.points)
    maps = np.zeros((nodes.shape[0] * nodes.shape[1], 13), np.float32)
    maps[nodes.index] = np.hstack([np.ones((len(places), 1)), frames.reshape(-1, 9), offsets])
    strain_95 = float(np.percentile(np.abs(strain), 95)) if len(strain) else 0.0
    return Chart(nodes.step_px, _widened(maps.reshape(*nodes.shape, 13)), strain_95)


def _widened(maps: Map) -> Map:
    """Give each missing node beside others their mean, so that the surface's rim beyond the last nodes is drawn too."""
    around = cv2.boxFilter(maps, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    beside = (maps[..., 0] == 0) & (around[..., 0] > 0)
    return np.where(beside[..., None], around / np.maximum(around[..., :1], 1), maps)


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)
