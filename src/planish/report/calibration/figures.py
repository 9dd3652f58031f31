"""Figures of the calibration's report: residuals, coverage of image, depth and tilt, rms per view, board's height."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from scipy.stats import norm

from planish.geometry import Array
from planish.report.calibration.numbers import pixels
from planish.report.style import DIVERGING, INK, MUTED, NEUTRAL, colour, diverging_map, nice_limit, png
from planish.sensing.calibrate.judge.advice import bad_views, device_title
from planish.sensing.calibrate.judge.coverage import Coverage, cell_centres
from planish.sensing.calibrate.judge.point_sigmas import point_sigmas
from planish.sensing.calibrate.judge.views import depths_mm, placements
from planish.sensing.calibrate.result import Calibration
from planish.sensing.capture.board import board_points

OUTLIER, EMPTY = "#d9480f", "#f3c9c2"
#: Residuals of the median length are drawn this long, as a share of the image's width; cell means likewise.
ARROW_SHARE, MEAN_SHARE = 0.014, 0.03
#: Relative widths of the panels of images and of the distribution beside them.
IMAGE_WIDTH, PLOT_WIDTH = 4.0, 2.4
#: Chi-square of two degrees of freedom that one in a thousand exceeds: -2 log 0.001.
MEAN_CHI2 = 13.8
count_map = LinearSegmentedColormap.from_list("points", ("#eef3f8", *DIVERGING[1::-1]))


def residuals_png(calibration: Calibration, item: Coverage) -> bytes:
    """Return residual vectors over the image, their means per cell, and the distribution of their components."""
    size = calibration.rig.devices[item.device].size_px
    own = point_sigmas(calibration, item.device)
    pixel, residual, outlier = (
        np.concatenate(values) for values in zip(*((r.pixel_px, r.residual_px, r.outlier) for r, _ in own), strict=True)
    )
    normalised = np.concatenate([r.residual_px / sigma[:, None] for r, sigma in own])
    figure = Figure(figsize=(12.4, 4.6 * size[1] / size[0] + 0.75), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(IMAGE_WIDTH, IMAGE_WIDTH, PLOT_WIDTH))
    spread(figure)
    length = float(np.median(np.linalg.norm(residual[~outlier], axis=1))) if (~outlier).any() else 1.0
    _arrows(left, pixel[~outlier], residual[~outlier], length, ARROW_SHARE, size, colour(0), 0.75)
    left.plot(*pixel[outlier].T, "o", color=OUTLIER, markersize=5, markerfacecolor="none", markeredgewidth=1.2)
    _image_frame(left, size, f"residuals; circles: {int(outlier.sum())} outliers")
    shown = np.isfinite(item.mean_px).all(-1)
    means = item.mean_px[shown]
    mean_length = float(np.median(np.linalg.norm(means, axis=1))) if len(means) else 1.0
    tones = np.where((means**2).sum(1) > MEAN_CHI2 * item.mean_sigma_px[shown] ** 2, OUTLIER, MUTED)
    _arrows(middle, cell_centres(size)[shown], means, mean_length, MEAN_SHARE, size, list(tones), 1.0)
    _image_frame(middle, size, "means over all views, per cell")
    right.set_box_aspect(size[1] / size[0] * IMAGE_WIDTH / PLOT_WIDTH)
    _distribution(right, normalised[~outlier], calibration.noise_px[item.device])
    return png(figure)


def _arrows(
    axis: Axes,
    pixel: Array,
    vector: Array,
    length: float,
    share: float,
    size: tuple[int, int],
    tone: str | list[str],
    alpha: float,
) -> None:
    if len(pixel) == 0 or not length > 0:
        return
    factor = share * size[0] / length
    axis.quiver(
        pixel[:, 0], pixel[:, 1], vector[:, 0] * factor, vector[:, 1] * factor, angles="xy", scale_units="xy", scale=1,
        color=tone, alpha=alpha, width=0.0016, headwidth=4, headlength=5, headaxislength=4.5, minlength=0,
    )  # fmt: skip
    # The scale stands under the image, where no arrow is.
    key = nice_limit([3 * length], least=1e-6)
    y = size[1] * 1.06
    axis.annotate(
        "", (size[0] * 0.01 + key * factor, y), (size[0] * 0.01, y), annotation_clip=False,
        arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.0},
    )  # fmt: skip
    axis.text(size[0] * 0.03 + key * factor, y, f"{key:g} px", fontsize=8, color=INK, va="center")


def _image_frame(axis: Axes, size: tuple[int, int], title: str) -> None:
    axis.set_xlim(-0.5, size[0] - 0.5)
    axis.set_ylim(size[1] - 0.5, -0.5)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color(NEUTRAL)
    axis.set_title(title, fontsize=9, color=INK, loc="left")


def _distribution(axis: Axes, normalised: Array, noise_px: float) -> None:
    edges = np.linspace(-5, 5, 41)
    middle = np.linspace(-5, 5, 201)
    for k, name in enumerate(("u", "v")):
        values = normalised[:, k][np.isfinite(normalised[:, k])]
        share = np.histogram(values, edges)[0] / max(1, len(values)) / (edges[1] - edges[0])
        axis.stairs(share, edges, color=colour(k), linewidth=1.4, label=name)
    axis.plot(middle, norm.pdf(middle), color=INK, linewidth=0.9, linestyle=(0, (4, 3)), label="normal")
    axis.set_xlim(-5, 5)
    axis.set_xlabel(f"residual / sigma (on the whole {pixels(noise_px)} px)", fontsize=8, color=MUTED)
    axis.set_yticks([])
    axis.legend(fontsize=8, frameon=False, loc="upper right", handlelength=1.4)
    axis.set_title("distribution", fontsize=9, color=INK, loc="left")
    clean(axis)


def spread(figure: Figure) -> None:
    """Keep panels of images apart, whatever their shape."""
    figure.set_layout_engine("constrained", wspace=0.04, w_pad=0.06)


def clean(axis: Axes) -> None:
    """Take the upper and right lines off and mute the labels."""
    axis.tick_params(labelsize=8, colors=MUTED)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def coverage_png(calibration: Calibration, maps: list[Coverage]) -> bytes:
    """Return the number of points per cell of each device's image."""
    sizes = [calibration.rig.devices[item.device].size_px for item in maps]
    tallest = max(size[1] / size[0] for size in sizes)
    figure = Figure(figsize=(4.1 * len(maps) + 0.1, 4.0 * tallest + 0.4), layout="constrained")
    spread(figure)
    most = max(int(item.count.max()) for item in maps)
    for axis, item, size in zip(np.atleast_1d(figure.subplots(1, len(maps))), maps, sizes, strict=True):
        rows, columns = item.count.shape
        width, height = size[0] / columns, size[1] / rows
        for row, column in np.ndindex(rows, columns):
            number, useful = int(item.count[row, column]), bool(item.useful[row, column])
            tone = count_map(Normalize(0, most)(number)) if number else EMPTY if useful else "#f1f2f3"
            corner = (column * width - 0.5, row * height - 0.5)
            axis.add_patch(Rectangle(corner, width, height, facecolor=tone, edgecolor="white", linewidth=1.0))
            ink = "white" if number > 0.55 * most else INK if useful or number else MUTED
            axis.text(corner[0] + width / 2, corner[1] + height / 2, f"{number}" if useful or number else "–",
                      fontsize=7.5, color=ink, ha="center", va="center", in_layout=False)  # fmt: skip
        _image_frame(axis, size, device_title(item.device))
    return png(figure)


def placement_png(calibration: Calibration) -> bytes:
    """Return to which side the boards faced, and the depths that each covered."""
    places = placements(calibration)
    near, middle, far = depths_mm(calibration)
    figure = Figure(figsize=(12.4, 3.5), layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=(1, 2.3))
    axis = figure.add_subplot(grid[0], projection="polar")
    tilt = np.degrees([p.tilt_rad for p in places])
    # Image axes: v points down.
    direction = [float(np.arctan2(-p.lean[1], p.lean[0])) for p in places]
    axis.scatter(direction, tilt, s=26, color=colour(0), edgecolors="white", linewidths=0.6, zorder=3)
    axis.set_ylim(0, max(45.0, float(tilt.max()) * 1.08))
    axis.set_xticks(np.radians([0, 90, 180, 270]), ["right", "up", "left", "down"], fontsize=8, color=MUTED)
    axis.set_yticks([15, 30, 45], ["15°", "30°", "45°"], fontsize=8, color=MUTED)
    axis.grid(color=NEUTRAL, linewidth=0.6)
    axis.spines["polar"].set_color(NEUTRAL)
    axis.set_title("tilt: where each board faces", fontsize=9, color=INK, pad=12)
    bars = figure.add_subplot(grid[1])
    names = [p.view for p in places]
    bars.bar(range(len(places)), [p.far_mm - p.near_mm for p in places], bottom=[p.near_mm for p in places],
             color=colour(0), alpha=0.75, width=0.7)  # fmt: skip
    bars.axhline(middle, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
    bars.set_ylim(near - 0.08 * (far - near), far + 0.08 * (far - near))
    bars.set_ylabel("depth [mm]", fontsize=8, color=MUTED)
    _view_labels(bars, names)
    bars.set_title(f"depth of each board; dashed: median, {middle:.0f} mm", fontsize=9, color=INK, loc="left")
    clean(bars)
    return png(figure)


#: More names than this under an axis overlap, longer ones take its space; a longer shared beginning is dropped.
MAX_NAMES, MAX_LETTERS, SHARED_LETTERS = 30, 18, 6


def _view_labels(axis: Axes, names: list[str]) -> None:
    axis.set_xlim(-0.7, len(names) - 0.3)
    if len(names) > MAX_NAMES:
        axis.set_xlabel("view, in the order of the input", fontsize=8, color=MUTED)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        return
    axis.set_xticks(range(len(names)), _short(names), rotation=60, ha="right", rotation_mode="anchor")


def _short(names: list[str]) -> list[str]:
    """Names without the beginning that all share (numbers are not cut), and no longer than MAX_LETTERS."""
    first, last = min(names), max(names)
    same = next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    shared = first[:same].rstrip("0123456789")
    own = [name[len(shared) :] for name in names] if len(shared) > SHARED_LETTERS else names
    return [name if len(name) <= MAX_LETTERS else f"…{name[1 - MAX_LETTERS :]}" for name in own]


def view_rms(calibration: Calibration, device: str) -> dict[str, float]:
    """Return the rms (2-D) per view [px] of a device; NaN where it saw none of its points."""
    out = {}
    for view in calibration.T_A_board:
        kept = [r.residual_px[~r.outlier] for r in calibration.residuals if r.device == device and r.view == view]
        squares = np.concatenate([(k**2).sum(1) for k in kept]) if kept else np.empty(0)
        out[view] = float(np.sqrt(squares.mean())) if len(squares) else float("nan")
    return out


def views_png(calibration: Calibration) -> bytes:
    """Return the rms of each view in each device as bars; conspicuous ones in another colour."""
    devices = list(calibration.rig.devices)
    figure = Figure(figsize=(12.4, 1.55 * len(devices) + 0.8), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(devices), 1, sharex=True))
    names = list(calibration.T_A_board)
    for axis, device in zip(axes, devices, strict=True):
        rms, bad = view_rms(calibration, device), bad_views(calibration, device)
        tones = [OUTLIER if name in bad else colour(0) for name in names]
        axis.bar(range(len(names)), np.nan_to_num([rms[name] for name in names]), color=tones, alpha=0.85, width=0.7)
        axis.axhline(float(np.nanmedian(list(rms.values()))), color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        axis.set_ylabel(f"{device_title(device)}\nrms [px]", fontsize=8, color=MUTED)
        axis.set_xlim(-0.7, len(names) - 0.3)
        clean(axis)
    _view_labels(axes[-1], names)
    return png(figure)


def height_png(calibration: Calibration) -> bytes | None:
    """Return the board's estimated height map, or None where it was not estimated."""
    if calibration.height_mm is None:
        return None
    points, height = board_points(calibration.observations.board), calibration.height_mm
    limit = nice_limit([float(np.nanmax(np.abs(height)))], least=1e-3)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axis = figure.add_subplot()
    drawn = axis.scatter(points[:, 0], points[:, 1], c=height, s=60, cmap=diverging_map, vmin=-limit, vmax=limit,
                         edgecolors=NEUTRAL, linewidths=0.5)  # fmt: skip
    axis.set_aspect("equal")
    axis.invert_yaxis()
    axis.set_xlabel("x [mm]", fontsize=8, color=MUTED)
    axis.set_ylabel("y [mm]", fontsize=8, color=MUTED)
    bar = figure.colorbar(drawn, ax=axis, shrink=0.8)
    bar.set_label("height [mm], + towards the sensor", fontsize=8, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=MUTED)
    bar.outline.set_visible(False)
    clean(axis)
    return png(figure)
