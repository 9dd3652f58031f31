"""The picture of one pair: textures with matches and consensus."""

from __future__ import annotations

import io

import cv2
import numpy as np
from PIL import Image

from planish.geometry import Array
from planish.registration.result import PairResult
from planish.report.scene import Item
from planish.report.style import rgb
from planish.report.thumbnail import TEXTURE_PX, Picture

GAP_PX = 16
#: No more lines than this are drawn of each kind: they would cover the texture.
MAX_LINES = 90
#: Colours of the picture's palette; few, as texture is noise to the compressor.
PALETTE_COLOURS = 96
MATCH, CONSENSUS = "#2f7fc1", "#d9480f"


def matches_png(pair: PairResult, a: Item, b: Item) -> bytes:
    """Return both textures side by side with matches (blue) and consensus (orange) as PNG."""
    pictures = [a.texture, b.texture]
    height = max(p.shape[0] for p in pictures)
    canvas = np.full((height, 2 * TEXTURE_PX + GAP_PX, 3), 255, np.uint8)
    for side, picture in enumerate(pictures):
        left = side * (TEXTURE_PX + GAP_PX)
        canvas[: picture.shape[0], left : left + TEXTURE_PX] = picture[..., None]
    scales = np.array([TEXTURE_PX / item.width_px for item in (a, b)])
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
