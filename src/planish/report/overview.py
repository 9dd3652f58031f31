"""The overview picture: all measurements of a group in their world, by measurement, texture and overlap error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from planish.geometry import Array, exp_so3, plane_frame
from planish.measurement import Map
from planish.report.scene import Item, Scene
from planish.report.style import INK, MUTED, NEUTRAL, colour, diverging_map, png, rgb

#: Width of one panel [px].
PANEL_PX = 900
#: Panels flatter than this (height over width) stand below each other.
STACK_BELOW = 0.6
#: The part is seen this far from straight above, so that its relief shows [rad].
TILT_RAD = 0.45
#: Direction of the light in the picture's frame (x right, y down, z away from the viewer).
LIGHT = np.array([-0.45, -0.55, -0.70])

Picture = NDArray[np.float64]


@dataclass(frozen=True)
class Layer:
    """One measurement as the picture sees it: per pixel the number of its points and their mean values."""

    item: Item
    count: Map
    shade: Map
    grey: Map
    error_mm: Map


def overview_png(scene: Scene) -> bytes:
    """Return the picture of the largest group as PNG: three panels, orthographic, one scale."""
    items = scene.group(scene.groups[0])
    T_view_world, pitch, size = view(items)
    layers = [_splat(item, T_view_world, pitch, size) for item in items]
    panels = [("measurements", _by_measurement(layers)), ("texture", _by_texture(layers))]
    has_error = any(np.isfinite(layer.error_mm).any() for layer in layers)
    if has_error:
        panels.append(("overlap error", _by_error(layers, scene.limit_mm)))
    figure, axes, colour_axis = _panels(len(panels), size[0] / size[1], has_error)
    for axis, (title, picture) in zip(axes, panels, strict=True):
        axis.imshow(picture, interpolation="antialiased")
        axis.text(0, 1.02, title, fontsize=10, color=INK, transform=axis.transAxes, va="bottom")
        axis.set_axis_off()
    _label(axes[0], layers)
    _scale_bar(axes[0], pitch, size)
    if colour_axis is not None:
        scale = ScalarMappable(Normalize(-scene.limit_mm, scene.limit_mm), diverging_map)
        bar = figure.colorbar(scale, cax=colour_axis, orientation="horizontal")
        bar.set_label("mm, positive = nearer to the sensor than the other measurement", fontsize=8, color=MUTED)
        colour_axis.tick_params(labelsize=8, colors=MUTED)
        bar.outline.set_visible(False)
    return png(figure, dpi=150)


def _panels(count: int, ratio: float, colour_bar: bool) -> tuple[Figure, list[Axes], Axes | None]:
    """Axes below each other for wide parts, side by side for others; `ratio` is height over width of a panel."""
    stacked = ratio < STACK_BELOW
    rows, columns = (count, 1) if stacked else (1, count)
    title, gap, foot = 0.32, 0.15, 0.62 if colour_bar else 0.1
    cell = (8.0, 8.0 * ratio) if stacked else (4.6, 4.6 * ratio)
    width = columns * cell[0] + (columns + 1) * gap
    height = rows * (cell[1] + title) + foot
    figure = Figure(figsize=(width, height))
    axes = []
    for i in range(count):
        row, column = (i, 0) if stacked else (0, i)
        left, bottom = gap + column * (cell[0] + gap), height - (row + 1) * (cell[1] + title)
        axes.append(figure.add_axes((left / width, bottom / height, cell[0] / width, cell[1] / height)))
    if not colour_bar:
        return figure, axes, None
    left = gap + (columns - 1) * (cell[0] + gap) + 0.2 * cell[0]
    return figure, axes, figure.add_axes((left / width, 0.42 / height, 0.6 * cell[0] / width, 0.1 / height))


def view(items: Sequence[Item]) -> tuple[Array, float, tuple[int, int]]:
    """Return T_view_world (x right along the extent, y down, z away), pitch [mm per px] and size (rows, columns)."""
    samples = [item.thinned(16)[:2] for item in items]
    known = [np.isfinite(p).all(-1) & np.isfinite(n).all(-1) for p, n in samples]
    points = np.concatenate([p[k] for (p, _), k in zip(samples, known, strict=True)]).astype(float)
    normal = np.concatenate([n[k] for (_, n), k in zip(samples, known, strict=True)]).astype(float).mean(0)
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


def _splat(item: Item, T_view_world: Array, pitch: float, size: tuple[int, int]) -> Layer:
    step = max(1, int(0.7 * pitch / item.prepared.gsd_mm))
    points, normals, grey, error = item.thinned(step)
    known = np.isfinite(points[..., 2]) & np.isfinite(normals[..., 2]) & np.isfinite(grey)
    flat = points[known] @ T_view_world[:2, :3].T.astype(np.float32) + T_view_world[:2, 3].astype(np.float32)
    column, row = np.rint(flat / pitch).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < size[1]) & (row < size[0])
    cells = row[inside] * size[1] + column[inside]
    facing = (normals[known] @ (T_view_world[:3, :3].T @ LIGHT).astype(np.float32)).clip(0, 1)[inside]

    def mean(values: Map) -> Map:
        good = np.isfinite(values)
        total = np.bincount(cells[good], values[good], size[0] * size[1])
        number = np.bincount(cells[good], minlength=size[0] * size[1])
        with np.errstate(invalid="ignore"):
            return _close_gaps((total / number).reshape(size).astype(np.float32))

    count = np.bincount(cells, minlength=size[0] * size[1]).reshape(size).astype(np.float32)
    return Layer(item, count, mean(facing), mean(grey[known][inside]), mean(error[known][inside]))


def _close_gaps(values: Map) -> Map:
    """Fill single empty pixels between filled ones (points fall on the raster unevenly)."""
    known = np.isfinite(values).astype(np.float32)
    around = cv2.boxFilter(known, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    total = cv2.boxFilter(np.nan_to_num(values), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    fill = (known == 0) & (around >= 5)
    return np.where(fill, total / np.maximum(around, 1), values)


def _mean(layers: Sequence[Layer], pictures: Sequence[Picture]) -> Picture:
    """Mean (rows, columns, 3) of the pictures where they are not NaN, white elsewhere."""
    stack = np.stack(pictures)
    known = np.isfinite(stack[..., :1])
    total, count = np.where(known, stack, 0).sum(0), known.sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), 1.0).clip(0, 1)


def _light(layer: Layer) -> Picture:
    return (0.5 + 0.62 * layer.shade[..., None].astype(float)).clip(0, 1.1)


def _by_measurement(layers: Sequence[Layer]) -> Picture:
    picture = _mean(layers, [_light(layer) * rgb(colour(layer.item.index)) for layer in layers])
    canvas = np.ascontiguousarray(np.rint(picture * 255).astype(np.uint8))
    for layer in layers:
        contours, _ = cv2.findContours(_footprint(layer), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        large = [c for c in contours if len(c) > 60]
        tone = [int(v) for v in rgb(colour(layer.item.index)) * 150]
        cv2.drawContours(canvas, large, -1, tone, 2, cv2.LINE_AA)
    return canvas / 255.0


def _by_texture(layers: Sequence[Layer]) -> Picture:
    picture = _mean(layers, [np.repeat(layer.grey[..., None].astype(float), 3, 2) for layer in layers])
    covered = np.isfinite(np.stack([layer.grey for layer in layers])).any(0)
    values = np.stack([np.where(np.isfinite(layer.grey), layer.grey, np.nan) for layer in layers])
    with np.errstate(invalid="ignore"):
        mean = np.nansum(values, 0) / np.maximum(np.isfinite(values).sum(0), 1)
    low, high = np.quantile(mean[covered], [0.01, 0.99]) if covered.any() else (0.0, 1.0)
    grey = 0.08 + 0.84 * ((mean - low) / max(high - low, 1e-6)).clip(0, 1)
    picture[covered] = grey[covered][:, None]
    return picture


def _by_error(layers: Sequence[Layer], limit: float) -> Picture:
    """Later measurements on top: in an overlap the two see the same distance with opposite signs, a mean hides it."""
    picture = np.ones((*layers[0].shade.shape, 3))
    for with_error in (False, True):
        for layer in layers:
            tone = diverging_map(Normalize(-limit, limit)(np.nan_to_num(layer.error_mm)))[..., :3]
            shaded = (tone if with_error else rgb(NEUTRAL)) * (0.55 + 0.45 * _light(layer))
            seen = np.isfinite(layer.shade) & (np.isfinite(layer.error_mm) | (not with_error))
            picture[seen] = shaded[seen].clip(0, 1)
    return picture


def _footprint(layer: Layer) -> NDArray[np.uint8]:
    filled = np.isfinite(layer.shade).astype(np.uint8)
    return cv2.morphologyEx(filled, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)).astype(np.uint8)


def _label(axis: Axes, layers: Sequence[Layer]) -> None:
    """Write each name where its measurement is seen and, as far as possible, no other one."""
    covered = sum(_footprint(layer).astype(int) for layer in layers)
    for layer in layers:
        own = _footprint(layer) > 0
        alone = own & (covered == 1)
        target = alone if alone.sum() > 0.15 * own.sum() else own
        distance = cv2.distanceTransform(np.pad(target.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
        row, column = np.unravel_index(int(np.argmax(distance)), distance.shape)
        axis.text(
            float(column), float(row), layer.item.placed.name, fontsize=8, color=INK, ha="center", va="center",
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "boxstyle": "round,pad=0.25"},
        )  # fmt: skip


def _scale_bar(axis: Axes, pitch: float, size: tuple[int, int]) -> None:
    length = next(v for v in (500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5) if v / pitch < 0.3 * size[1] or v == 0.5)
    x, y = 0.03 * size[1], size[0] - 12.0
    axis.plot([x, x + length / pitch], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    axis.text(x + 0.5 * length / pitch, y - 8, f"{length:g} mm", fontsize=8, color=INK, ha="center", va="bottom")
