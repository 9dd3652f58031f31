"""The overview picture: all measurements of a group in their world, by measurement, texture and overlap error."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from planish.report.scene import Item, Layer, Scene
from planish.report.style import INK, MUTED, NEUTRAL, colour, diverging_map, png, rgb

#: Panels flatter than this (height over width) stand below each other.
STACK_BELOW = 0.6
#: More names than this would cover the picture.
MAX_NAMES = 60

Picture = NDArray[np.float64]


#: A measurement and its part of the panel.
Layers = Sequence[tuple[Item, Layer]]


def overview_png(scene: Scene) -> bytes:
    """Return the picture of the largest group as PNG: three panels, orthographic, one scale."""
    pitch, size = scene.plan.pitch, scene.plan.size
    layers = [(item, item.layer) for item in scene.items if item.layer is not None]
    panels = [("measurements", _by_measurement(layers, size)), ("texture", _by_texture(layers, size))]
    has_error = any(np.isfinite(layer.error_mm).any() for _, layer in layers)
    if has_error:
        panels.append(("overlap error", _by_error(layers, size, scene.limit_mm)))
    figure, axes, colour_axis = _panels(len(panels), size[0] / size[1], has_error)
    for axis, (title, picture) in zip(axes, panels, strict=True):
        axis.imshow(picture, interpolation="antialiased")
        axis.text(0, 1.02, title, fontsize=10, color=INK, transform=axis.transAxes, va="bottom")
        axis.set_axis_off()
    if len(layers) <= MAX_NAMES:
        _label(axes[0], layers, size)
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


def _mean(layers: Layers, pictures: Iterable[Picture], size: tuple[int, int]) -> Picture:
    """Mean (rows, columns, channels) of the pictures of all layers where they are not NaN, NaN elsewhere."""
    total: Picture | None = None
    count = np.zeros((*size, 1))
    for (_, layer), picture in zip(layers, pictures, strict=True):
        total = np.zeros((*size, picture.shape[2])) if total is None else total
        known = np.isfinite(picture[..., :1])
        total[layer.window] += np.where(known, picture, 0)
        count[layer.window] += known
    assert total is not None
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, total / count, np.nan)


def _light(layer: Layer) -> Picture:
    return (0.5 + 0.62 * layer.shade[..., None].astype(float)).clip(0, 1.1)


def _by_measurement(layers: Layers, size: tuple[int, int]) -> Picture:
    picture = _mean(layers, (_light(layer) * rgb(colour(item.index)) for item, layer in layers), size)
    canvas = np.ascontiguousarray(np.rint(np.nan_to_num(picture, nan=1.0).clip(0, 1) * 255).astype(np.uint8))
    for item, layer in layers:
        contours, _ = cv2.findContours(
            _footprint(layer), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(layer.column, layer.row)
        )
        large = [c for c in contours if len(c) > 60]
        tone = [int(v) for v in rgb(colour(item.index)) * 150]
        cv2.drawContours(canvas, large, -1, tone, 2, cv2.LINE_AA)
    return canvas / 255.0


def _by_texture(layers: Layers, size: tuple[int, int]) -> Picture:
    mean = _mean(layers, (layer.grey[..., None].astype(float) for _, layer in layers), size)[..., 0]
    covered = np.isfinite(mean)
    low, high = np.quantile(mean[covered], [0.01, 0.99]) if covered.any() else (0.0, 1.0)
    grey = 0.08 + 0.84 * ((mean - low) / max(high - low, 1e-6)).clip(0, 1)
    return np.repeat(np.where(covered, grey, 1.0)[..., None], 3, axis=2)


def _by_error(layers: Layers, size: tuple[int, int], limit: float) -> Picture:
    """Later measurements on top: in an overlap the two see the same distance with opposite signs, a mean hides it."""
    picture = np.ones((*size, 3))
    for with_error in (False, True):
        for _, layer in layers:
            tone = diverging_map(Normalize(-limit, limit)(np.nan_to_num(layer.error_mm)))[..., :3]
            shaded = (tone if with_error else rgb(NEUTRAL)) * (0.55 + 0.45 * _light(layer))
            seen = np.isfinite(layer.shade) & (np.isfinite(layer.error_mm) | (not with_error))
            picture[layer.window][seen] = shaded[seen].clip(0, 1)
    return picture


def _footprint(layer: Layer) -> NDArray[np.uint8]:
    filled = np.isfinite(layer.shade).astype(np.uint8)
    return cv2.morphologyEx(filled, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)).astype(np.uint8)


def _label(axis: Axes, layers: Layers, size: tuple[int, int]) -> None:
    """Write each name where its measurement is seen and, as far as possible, no other one."""
    covered = np.zeros(size, int)
    for _, layer in layers:
        covered[layer.window] += _footprint(layer)
    for item, layer in layers:
        own = _footprint(layer) > 0
        alone = own & (covered[layer.window] == 1)
        target = alone if alone.sum() > 0.15 * own.sum() else own
        distance = cv2.distanceTransform(np.pad(target.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
        row, column = np.unravel_index(int(np.argmax(distance)), distance.shape)
        axis.text(
            float(column + layer.column), float(row + layer.row), item.name, fontsize=8, color=INK, ha="center",
            va="center", bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "boxstyle": "round,pad=0.25"},
        )  # fmt: skip


def _scale_bar(axis: Axes, pitch: float, size: tuple[int, int]) -> None:
    length = next(v for v in (500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5) if v / pitch < 0.3 * size[1] or v == 0.5)
    x, y = 0.03 * size[1], size[0] - 12.0
    axis.plot([x, x + length / pitch], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    axis.text(x + 0.5 * length / pitch, y - 8, f"{length:g} mm", fontsize=8, color=INK, ha="center", va="bottom")
