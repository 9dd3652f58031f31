"""Pictures of one pair: textures with matches and consensus, histogram of the overlap error."""

from __future__ import annotations

import io

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from planish.evaluation.overlap import OverlapEvaluation
from planish.evaluation.prepared import Prepared
from planish.geometry import Array
from planish.measurement import Map
from planish.registration.result import PairResult
from planish.report.style import INK, MUTED, colour, png, rgb

#: Width of one texture image in the picture of the matches [px].
TEXTURE_PX = 640
GAP_PX = 16
#: No more lines than this are drawn of each kind: they would cover the texture.
MAX_LINES = 90
#: Grey levels of the picture (texture is noise to the compressor: fewer levels, smaller file).
GREY_LEVELS = 24
#: Darkest and lightest grey of a texture: the lines must stand out.
DARK, LIGHT = 84, 236
#: Colours of the picture's palette; few, as texture is noise to the compressor.
PALETTE_COLOURS = 96
MATCH, CONSENSUS = "#2f7fc1", "#d9480f"

Picture = NDArray[np.uint8]


def texture_picture(item: Prepared, width: int = TEXTURE_PX) -> Picture:
    """Return the local contrast as a grey picture (h, width), stretched to 4 robust standard deviations."""
    value = item.contrast[0]
    scale = width / value.shape[1]
    size = (width, max(1, round(value.shape[0] * scale)))
    known = np.isfinite(value)
    reduced = cv2.resize(np.where(known, value, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    with np.errstate(invalid="ignore", divide="ignore"):
        reduced = np.where(share > 0.5, reduced / share, np.nan)
    seen = reduced[np.isfinite(reduced)]
    spread = 1.4826 * float(np.median(np.abs(seen - np.median(seen)))) if len(seen) else 1.0
    level = np.rint((0.5 + reduced / (8 * max(spread, 1e-9))).clip(0, 1) * (GREY_LEVELS - 1)) / (GREY_LEVELS - 1)
    return np.where(np.isfinite(level), DARK + (LIGHT - DARK) * np.nan_to_num(level), 255).astype(np.uint8)


def matches_png(pair: PairResult, a: Prepared, b: Prepared) -> bytes:
    """Return both textures side by side with matches (blue) and consensus (orange) as PNG."""
    pictures = [texture_picture(a), texture_picture(b)]
    height = max(p.shape[0] for p in pictures)
    canvas = np.full((height, 2 * TEXTURE_PX + GAP_PX, 3), 255, np.uint8)
    for side, picture in enumerate(pictures):
        left = side * (TEXTURE_PX + GAP_PX)
        canvas[: picture.shape[0], left : left + TEXTURE_PX] = picture[..., None]
    scales = np.array([TEXTURE_PX / item.measurement.shape[1] for item in (a, b)])
    rest = _without(pair.matches_px, pair.consensus_px)
    canvas = _draw(canvas, rest, scales, MATCH, 0.55)
    canvas = _draw(canvas, pair.consensus_px, scales, CONSENSUS, 0.8)
    buffer = io.BytesIO()
    few = Image.fromarray(canvas).quantize(PALETTE_COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.save(buffer, format="png", compress_level=6)
    return buffer.getvalue()


def _without(matches: Array, consensus: Array) -> Array:
    """Matches (N, 4) that do not belong to the consensus."""
    inside = {tuple(row) for row in np.round(consensus, 3)}
    return matches[[tuple(row) not in inside for row in np.round(matches, 3)]] if len(matches) else matches


def _draw(canvas: Picture, lines: Array, scales: Array, tone: str, strength: float) -> Picture:
    if len(lines) == 0:
        return canvas
    picks = np.unique(np.linspace(0, len(lines) - 1, min(len(lines), MAX_LINES)).astype(int))
    # Sixteenths of a pixel: OpenCV draws on whole pixels otherwise.
    shift = 4
    start = lines[picks, :2] * scales[0]
    end = lines[picks, 2:] * scales[1] + [TEXTURE_PX + GAP_PX, 0]
    overlay = canvas.copy()
    ink = [int(v) for v in np.rint(rgb(tone) * 255)]
    for p, q in zip(np.rint(start * 2**shift).astype(int), np.rint(end * 2**shift).astype(int), strict=True):
        cv2.line(overlay, p.tolist(), q.tolist(), ink, 1, cv2.LINE_AA, shift)
        for end_point in (p, q):
            cv2.circle(overlay, end_point.tolist(), 3 * 2**shift, ink, 1, cv2.LINE_AA, shift)
    return cv2.addWeighted(overlay, strength, canvas, 1 - strength, 0).astype(np.uint8)


def histogram_png(evaluation: OverlapEvaluation, index_b: int) -> bytes:
    """Return the histogram of the signed distances of one pair as PNG."""
    values: Map = evaluation.distance_mm[np.isfinite(evaluation.distance_mm)]
    figure = Figure(figsize=(4.6, 2.5), layout="constrained")
    axis = figure.add_subplot()
    if len(values):
        limit = max(float(np.quantile(np.abs(values), 0.998)) * 1.15, 1e-3)
        counts, edges = np.histogram(values, bins=101, range=(-limit, limit))
        axis.stairs(counts / len(values) * 100, edges, fill=True, color=colour(index_b), alpha=0.85)
        axis.axvline(0, color=INK, linewidth=0.8)
        for quantile in np.quantile(values, [0.025, 0.975]):
            axis.axvline(float(quantile), color=MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
        axis.set_xlim(-limit, limit)
    axis.set_xlabel("signed distance [mm] (dashed: 95 % of the points)", fontsize=8, color=MUTED)
    axis.set_ylabel("points [%]", fontsize=8, color=MUTED)
    axis.tick_params(labelsize=8, colors=MUTED)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    return png(figure)
