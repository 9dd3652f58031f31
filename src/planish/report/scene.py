"""What the pictures show of each measurement: grey values and overlap error on its own pixel grid, thinned alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.evaluation.overlap import OverlapEvaluation, OverlapOptions
from planish.evaluation.prepared import Prepared
from planish.files.cloud import intensity
from planish.geometry import transform_points
from planish.measurement import Map
from planish.registration.result import PlacedMeasurement, Registration
from planish.report.style import nice_limit

#: Edge of the cells over which the drawn error is averaged [mm].
CELL_MM = OverlapOptions().cell_mm
#: Share of the overlap errors that the colour scale spans.
ERROR_QUANTILE = 0.99


@dataclass(frozen=True)
class Item:
    """One placed measurement with everything that is drawn of it, on its own pixel grid.

    Parameters
    ----------
    placed : PlacedMeasurement
        Name, group and place.
    index : int
        Its position among all measurements; gives its colour.
    prepared : Prepared
        The measurement.
    grey : ndarray (H, W) float32
        Grey value relative to the measurement's median: exposures differ.
    error_mm : ndarray (H, W) float32
        Mean signed distance from the measurements it overlaps, positive where it is nearer to the sensor than they;
        NaN outside all overlaps.
    """

    placed: PlacedMeasurement
    index: int
    prepared: Prepared
    grey: Map
    error_mm: Map

    def thinned(self, step: int) -> tuple[Map, Map, Map, Map]:
        """Return points (h, w, 3) and normals in world, grey and error (h, w) of every `step`-th pixel.

        Grey is the mean over the pixels that a thinned one stands for; the error is the mean over at least the cells
        over which min and max of the overlap error are taken, so that it shows surfaces and not noise.
        """
        picks = (slice(step // 2, None, step),) * 2
        T = self.placed.T_world_measurement
        surface = self.prepared.surface
        points = transform_points(T, surface.points_sensor[picks])
        normals = (surface.normals_sensor[picks] @ T[:3, :3].T).astype(np.float32)
        cell = max(step, round(CELL_MM / self.prepared.gsd_mm))
        error = np.where(np.isfinite(self.error_mm), box_mean(self.error_mm, cell), np.float32(np.nan))
        return points, normals, box_mean(self.grey, step)[picks], error[picks]


@dataclass(frozen=True)
class Scene:
    """All measurements of a registration, ready to be drawn; `limit_mm` is the end of the error's colour scale."""

    items: tuple[Item, ...]
    groups: tuple[int, ...]
    limit_mm: float

    def group(self, group: int) -> tuple[Item, ...]:
        """Return the members of a group."""
        return tuple(item for item in self.items if item.placed.group == group)


def build_scene(
    registration: Registration,
    prepared: Mapping[str, Prepared],
    evaluations: Sequence[OverlapEvaluation],
) -> Scene:
    """Gather what the pictures show; groups are ordered by size, the largest first."""
    items = []
    for index, placed in enumerate(registration.measurements):
        item = prepared[placed.name]
        items.append(Item(placed, index, item, _relative_grey(item), _error(placed.name, item, evaluations)))
    sizes = {g.id: sum(m.group == g.id for m in registration.measurements) for g in registration.groups}
    groups = tuple(sorted(sizes, key=lambda group: (-sizes[group], group)))
    return Scene(tuple(items), groups, nice_limit([_quantile(item.error_mm) for item in items]))


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


def _error(name: str, item: Prepared, evaluations: Sequence[OverlapEvaluation]) -> Map:
    maps = [e.distance_mm for e in evaluations if e.b == name] + [
        e.distance_of_a_mm for e in evaluations if e.a == name
    ]
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
