"""Maps over the image: expected 3D error, distortion."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from planish.geometry import Array
from planish.report.calibration.figures import spread
from planish.report.style import INK, MUTED, NEUTRAL, nice_limit, png
from planish.rig import Camera
from planish.sensing.calibrate.judge.advice import device_title
from planish.sensing.calibrate.judge.expected_error import ExpectedError, pixel_grid

error_map = LinearSegmentedColormap.from_list("expected error", ("#faf7ee", "#f2cf8f", "#dd7f3b", "#8c1d18"))
distortion_map = LinearSegmentedColormap.from_list("distortion", ("#f7fafc", "#7fa9d8", "#1f4e9c"))
#: The colours end at this quantile: a corner's few places must not take all of them.
QUANTILE = 0.995
#: Quantiles between which contour lines are drawn, and the range, as a share, below which a map is even.
SHOWN, LEAST_RANGE = (0.01, 0.99), 1e-2


def error_png(error: ExpectedError, size_px: tuple[int, int]) -> bytes:
    """Return the expected error over the image: in the sensor frame, of form, and its part by the scale."""
    figure = Figure(figsize=(12.4, 3.9 * size_px[1] / size_px[0] + 0.9), layout="constrained")
    titles = ("in the sensor frame", "form: less the best rigid motion", "of it by the scale")
    maps = (error.sensor_mm, error.form_mm, error.scale_mm)
    # Form and its part share their colours; the error in the sensor frame may be many times larger.
    form = _top(error.form_mm)
    for axis, title, values, top in zip(
        figure.subplots(1, 3), titles, maps, (_top(error.sensor_mm), form, form), strict=True
    ):
        _map(figure, axis, values, top, size_px, "mm", error_map)
        axis.set_title(title, fontsize=9, color=INK, loc="left")
    return png(figure)


def distortion_png(devices: dict[str, Camera]) -> bytes:
    """Return by how much the lenses shift the image, over the images."""
    tallest = max(camera.size_px[1] / camera.size_px[0] for camera in devices.values())
    figure = Figure(figsize=(4.1 * len(devices) + 0.1, 3.9 * tallest + 0.9), layout="constrained")
    spread(figure)
    for axis, (name, camera) in zip(np.atleast_1d(figure.subplots(1, len(devices))), devices.items(), strict=True):
        shift = distortion_px(camera, pixel_grid(camera))
        _map(figure, axis, shift, _top(shift), camera.size_px, "px", distortion_map)
        axis.set_title(device_title(name), fontsize=9, color=INK, loc="left")
    return png(figure)


def distortion_px(camera: Camera, pixel_px: Array) -> Array:
    """Return the length (h, w) [px] of the shift by the distortion at pixels (h, w, 2)."""
    y = (pixel_px[..., 1] - camera.K[1, 2]) / camera.K[1, 1]
    x = (pixel_px[..., 0] - camera.K[0, 2] - camera.K[0, 1] * y) / camera.K[0, 0]
    rays = camera.rays_sensor(pixel_px) @ camera.T_camera_sensor[:3, :3].T
    difference = np.stack([x, y], -1) - rays[..., :2] / rays[..., 2:]
    return np.asarray(np.linalg.norm(difference @ camera.K[:2, :2].T, axis=-1))


def _top(values: Array) -> float:
    known = values[np.isfinite(values)]
    return max(float(np.quantile(known, QUANTILE)), 1e-12) if len(known) else 1.0


def _map(
    figure: Figure,
    axis: Axes,
    values: Array,
    top: float,
    size_px: tuple[int, int],
    unit: str,
    colours: LinearSegmentedColormap,
) -> None:
    extent = (-0.5, size_px[0] - 0.5, size_px[1] - 0.5, -0.5)
    axis.set_facecolor("#eceeef")
    drawn = axis.imshow(values, extent=extent, cmap=colours, vmin=0, vmax=top, interpolation="nearest")
    levels = _levels(values)
    if len(levels):
        u = (np.arange(values.shape[1]) + 0.5) * size_px[0] / values.shape[1] - 0.5
        v = (np.arange(values.shape[0]) + 0.5) * size_px[1] / values.shape[0] - 0.5
        lines = axis.contour(u, v, values, levels=levels, colors=INK, linewidths=0.7)
        digits = max(0, -math.floor(math.log10(_step(values)) + 1e-9))
        axis.clabel(lines, fmt=lambda value: f"{value:.{digits}f}", fontsize=8)
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color(NEUTRAL)
    bar = figure.colorbar(drawn, ax=axis, orientation="horizontal", shrink=0.8, pad=0.03, aspect=34)
    bar.ax.tick_params(labelsize=8, colors=MUTED)
    bar.set_label(unit, fontsize=8, color=MUTED)
    bar.outline.set_visible(False)


def _levels(values: Array) -> NDArray[np.float64]:
    """Four or five round levels inside the range of the values; none where they are all alike."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return np.empty(0)
    low, high = np.quantile(known, SHOWN)
    if not high - low > LEAST_RANGE * high:
        return np.empty(0)
    step = _step(values)
    return np.asarray(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step)


def _step(values: Array) -> float:
    """Round distance of four or five levels."""
    low, high = np.nanquantile(values, SHOWN)
    return nice_limit([float(high - low) / 5], least=1e-9)
