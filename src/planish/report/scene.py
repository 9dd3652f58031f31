"""What the pictures show of each measurement: small maps, drawn from one measurement at a time.

A report never holds all measurements: `sample` says roughly where one lies, `plan_scene` from all samples how the part
is seen, and `draw` makes of one measurement, while it is at hand, everything that will be shown of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.evaluation.overlap import OverlapOptions
from planish.evaluation.prepared import Prepared
from planish.files.cloud import intensity
from planish.geometry import Array, exp_so3, plane_frame, transform_points
from planish.measurement import Map
from planish.registration.result import PlacedMeasurement, Registration
from planish.report.histogram import Histogram
from planish.report.style import nice_limit
from planish.report.thumbnail import Picture, texture_picture

#: Edge of the cells over which the drawn error is averaged [mm].
CELL_MM = OverlapOptions().cell_mm
#: Share of the overlap errors that the colour scale spans.
ERROR_QUANTILE = 0.99
#: Every n-th pixel of a sample, along both axes.
SAMPLE_STEP = 16
#: Width of one panel of the overview [px].
PANEL_PX = 900
#: The part is seen this far from straight above, so that its relief shows [rad].
TILT_RAD = 0.45
#: Direction of the light in the picture's frame (x right, y down, z away from the viewer).
LIGHT = np.array([-0.45, -0.55, -0.70])
#: With fewer points than this there is nothing to be seen.
MIN_POINTS = 10
#: Most grid points of the 3D view per measurement, and of all together: what a browser without graphics card still
#: turns smoothly, and what a mail still carries.
MAX_POINTS, MAX_POINTS_IN_ALL = 25_000, 1_500_000


@dataclass(frozen=True)
class Sample:
    """Where a measurement lies: a few points (h, w, 3) with normals, in its own frame."""

    points_sensor: Map
    normals_sensor: Map


@dataclass(frozen=True)
class Plan:
    """How the largest group is seen: T_view_world (x right along the extent, y down, z away), pitch [mm per px], size.

    `size` is (rows, columns); `members` are the names of the group; `max_points` those of a grid of the 3D view.
    """

    T_view_world: Array
    pitch: float
    size: tuple[int, int]
    members: frozenset[str]
    max_points: int


@dataclass(frozen=True)
class Grid:
    """A measurement for the 3D view, thinned: points (h, w, 3) in world [mm], grey and overlap error (h, w) [mm]."""

    points: Map
    grey: Map
    error_mm: Map


@dataclass(frozen=True)
class Layer:
    """A measurement in the overview: a part of the panel from `row`, `column` on, with mean values per pixel.

    Parameters
    ----------
    row, column : int
        First row and column of the part in the panel [px].
    shade : ndarray (h, w) float32
        How much the surface faces the light; NaN where nothing is seen, as in the other maps.
    grey : ndarray (h, w) float32
        Grey value relative to the measurement's median: exposures differ.
    error_mm : ndarray (h, w) float32
        Mean signed distance from the measurements it overlaps, positive where it is nearer to the sensor than they.
    """

    row: int
    column: int
    shade: Map
    grey: Map
    error_mm: Map

    @property
    def window(self) -> tuple[slice, slice]:
        """The part of the panel."""
        rows, columns = self.shade.shape
        return slice(self.row, self.row + rows), slice(self.column, self.column + columns)


@dataclass(frozen=True)
class Item:
    """Everything that is shown of one measurement.

    Parameters
    ----------
    name : str
    index : int
        Its position among all measurements; gives its colour.
    points : int
        Number of its points.
    width_px : int
        Of its pixel grid.
    gsd_mm : float
        Ground sample distance [mm per pixel].
    error_quantile_mm : float
        Quantile of its overlap errors, for the scale of all.
    grid : Grid
    layer : Layer or None
        None outside the group of the overview.
    texture : ndarray (h, w) uint8
        Picture of its texture.
    histograms : dict of Histogram
        Overlap errors of its pairs in which it is b, by a.
    """

    name: str
    index: int
    points: int
    width_px: int
    gsd_mm: float
    error_quantile_mm: float
    grid: Grid
    layer: Layer | None
    texture: Picture
    histograms: Mapping[str, Histogram]


@dataclass(frozen=True)
class Scene:
    """All measurements of a registration as they are shown; groups are ordered by size, the largest first."""

    registration: Registration
    plan: Plan
    items: tuple[Item, ...]

    @property
    def groups(self) -> tuple[int, ...]:
        """Numbers of the groups."""
        return _groups(self.registration)

    @property
    def limit_mm(self) -> float:
        """End of the error's colour scale."""
        return nice_limit([item.error_quantile_mm for item in self.items])


def sample(item: Prepared) -> Sample:
    """Return where a measurement lies."""
    picks = (slice(SAMPLE_STEP // 2, None, SAMPLE_STEP),) * 2
    return Sample(item.surface.points_sensor[picks].copy(), item.surface.normals_sensor[picks].copy())


def plan_scene(registration: Registration, samples: Mapping[str, Sample]) -> Plan:
    """Return how the largest group is seen; `samples` are those of its members at least."""
    group = _groups(registration)[0]
    points, normals = [], []
    for placed in registration.measurements:
        if placed.group == group:
            T, seen = placed.T_world_measurement, samples[placed.name]
            known = np.isfinite(seen.points_sensor).all(-1) & np.isfinite(seen.normals_sensor).all(-1)
            points.append(transform_points(T, seen.points_sensor[known]))
            normals.append(seen.normals_sensor[known].astype(float) @ T[:3, :3].T)
    cloud = np.concatenate(points).astype(float)
    if len(cloud) < MIN_POINTS:
        T_view_world, pitch, size = np.eye(4), 1.0, (PANEL_PX // 2, PANEL_PX)
    else:
        T_view_world, pitch, size = _view(cloud, np.concatenate(normals).mean(0))
    members = frozenset(m.name for m in registration.measurements if m.group == group)
    share = MAX_POINTS_IN_ALL // len(registration.measurements)
    return Plan(T_view_world, pitch, size, members, max(1, min(MAX_POINTS, share)))


def draw(
    placed: PlacedMeasurement, index: int, plan: Plan, item: Prepared, distances: Mapping[tuple[str, str], Map]
) -> Item:
    """Return what is shown of a measurement.

    Parameters
    ----------
    index : int
        Its position among all measurements.
    distances : mapping of ndarray (H, W) float32
        Per accepted pair (a, b) of the measurement its points' signed distance from the other one, on its own pixel
        grid, positive where it is nearer to the sensor [mm]; NaN outside the overlap.
    """
    name, T = placed.name, placed.T_world_measurement
    grey, error = _relative_grey(item), _mean_error(item, list(distances.values()))
    return Item(
        name=name,
        index=index,
        points=int(item.measurement.valid.sum()),
        width_px=item.measurement.shape[1],
        gsd_mm=item.gsd_mm,
        error_quantile_mm=_quantile(error),
        grid=_grid(item, T, grey, error, plan.max_points),
        layer=_layer(item, T, grey, error, plan) if name in plan.members else None,
        texture=texture_picture(item),
        histograms={a: Histogram.of(distance) for (a, b), distance in distances.items() if b == name},
    )


def grid_step(shape: tuple[int, int], max_points: int = MAX_POINTS) -> int:
    """Return the smallest step that leaves at most `max_points` grid points."""
    step = 1
    while (-(-shape[0] // step)) * (-(-shape[1] // step)) > max_points:
        step += 1
    return step


def _groups(registration: Registration) -> tuple[int, ...]:
    sizes = {g.id: sum(m.group == g.id for m in registration.measurements) for g in registration.groups}
    return tuple(sorted(sizes, key=lambda group: (-sizes[group], group)))


def _view(points: Array, normal: Array) -> tuple[Array, float, tuple[int, int]]:
    centre = points.mean(0)
    longest = np.linalg.eigh(np.cov((points - centre).T))[1][:, -1]
    longest = longest * (1.0 if longest[np.argmax(np.abs(longest))] > 0 else -1.0)
    T_view_world = plane_frame(centre, -normal, longest)
    tilt = np.eye(4)
    tilt[:3, :3] = exp_so3([TILT_RAD, 0, 0])
    T_view_world = tilt @ T_view_world
    flat = points @ T_view_world[:2, :3].T + T_view_world[:2, 3]
    low, high = flat.min(0), flat.max(0)
    pitch = float((high - low)[0] / (0.96 * PANEL_PX))
    margin = 0.02 * PANEL_PX * pitch
    shift = np.eye(4)
    shift[:2, 3] = margin - low
    rows = int(np.ceil((high - low + 2 * margin)[1] / pitch))
    return shift @ T_view_world, pitch, (rows, PANEL_PX)


def _thinned(item: Prepared, T: Array, grey: Map, error: Map, step: int) -> tuple[Map, Map, Map, Map]:
    """Return points (h, w, 3) and normals in world, grey and error (h, w) of every `step`-th pixel.

    Grey is the mean over the pixels that a thinned one stands for; the error is the mean over at least the cells
    over which min and max of the overlap error are taken, so that it shows surfaces and not noise.
    """
    picks = (slice(step // 2, None, step),) * 2
    points = transform_points(T, item.surface.points_sensor[picks])
    normals = (item.surface.normals_sensor[picks] @ T[:3, :3].T).astype(np.float32)
    cell = max(step, round(CELL_MM / _gsd_mm(item)))
    smooth = np.where(np.isfinite(error), box_mean(error, cell), np.float32(np.nan))
    return points, normals, box_mean(grey, step)[picks], smooth[picks]


def _gsd_mm(item: Prepared) -> float:
    """Return the ground sample distance [mm per pixel], any number for a measurement without points."""
    return item.gsd_mm if np.isfinite(item.gsd_mm) else 1.0


def _grid(item: Prepared, T: Array, grey: Map, error: Map, max_points: int) -> Grid:
    points, _, grey, error = _thinned(item, T, grey, error, grid_step(item.measurement.shape, max_points))
    return Grid(points, grey.copy(), error.copy())


def _layer(item: Prepared, T: Array, grey: Map, error: Map, plan: Plan) -> Layer:
    step = max(1, int(0.7 * plan.pitch / _gsd_mm(item)))
    points, normals, grey, error = _thinned(item, T, grey, error, step)
    view, size = plan.T_view_world.astype(np.float32), plan.size
    known = np.isfinite(points[..., 2]) & np.isfinite(normals[..., 2]) & np.isfinite(grey)
    flat = points[known] @ view[:2, :3].T + view[:2, 3]
    column, row = np.rint(flat / plan.pitch).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < size[1]) & (row < size[0])
    cells = row[inside] * size[1] + column[inside]
    facing = (normals[known] @ (plan.T_view_world[:3, :3].T @ LIGHT).astype(np.float32)).clip(0, 1)[inside]
    # A margin, so that what is done to the rim of the measurement is not done to that of the part.
    first = np.maximum([row[inside].min(initial=0), column[inside].min(initial=0)], 8) - 8 if inside.any() else (0, 0)
    last = (row[inside].max(initial=0) + 9, column[inside].max(initial=0) + 9)
    window = slice(int(first[0]), int(last[0])), slice(int(first[1]), int(last[1]))

    def mean(values: Map) -> Map:
        good = np.isfinite(values)
        total = np.bincount(cells[good], values[good], size[0] * size[1])
        number = np.bincount(cells[good], minlength=size[0] * size[1])
        with np.errstate(invalid="ignore"):
            return _close_gaps((total / number).reshape(size).astype(np.float32)[window])

    return Layer(int(first[0]), int(first[1]), mean(facing), mean(grey[known][inside]), mean(error[known][inside]))


def _close_gaps(values: Map) -> Map:
    """Fill single empty pixels between filled ones (points fall on the raster unevenly)."""
    known = np.isfinite(values).astype(np.float32)
    around = cv2.boxFilter(known, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    total = cv2.boxFilter(np.nan_to_num(values), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    fill = (known == 0) & (around >= 5)
    return np.where(fill, total / np.maximum(around, 1), values)


def box_mean(values: Map, size: int) -> Map:
    """Return the mean over size x size windows of the values that are not NaN (NaN where there are none)."""
    if size <= 1:
        return values
    known = np.isfinite(values)
    total = _box_sum(np.where(known, values, 0).astype(np.float32), size)
    count = _box_sum(known.astype(np.float32), size)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0.5, total / count, np.float32(np.nan))


def _box_sum(values: Map, size: int) -> Map:
    return cv2.boxFilter(values, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _relative_grey(item: Prepared) -> Map:
    grey = np.where(item.measurement.valid, intensity(item.measurement), np.float32(np.nan))
    middle = np.nanmedian(grey[::4, ::4]) if np.isfinite(grey[::4, ::4]).any() else 1.0
    return (grey / np.float32(middle if middle > 0 else 1.0)).astype(np.float32)


def _mean_error(item: Prepared, maps: Sequence[Map]) -> Map:
    total = np.zeros(item.measurement.shape, np.float32)
    count: NDArray[np.float32] = np.zeros(item.measurement.shape, np.float32)
    for distances in maps:
        known = np.isfinite(distances)
        total[known] += distances[known]
        count += known
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, total / count, np.float32(np.nan))


def _quantile(error_mm: Map) -> float:
    values = np.abs(box_mean(error_mm, 5)[2::5, 2::5])
    values = values[np.isfinite(values)]
    return float(np.quantile(values, ERROR_QUANTILE)) if len(values) else 0.0
