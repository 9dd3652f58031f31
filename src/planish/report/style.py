"""Colours and figure helpers shared by all pictures of the report."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from planish import storage

#: Measurements, in order (Okabe and Ito's colours that people with any colour vision tell apart, softened).
PALETTE = ("#3b7dbf", "#e08a2e", "#3fa37a", "#c05a8c", "#8a6fc4", "#b0a02c", "#58b0d8", "#a0583c")
#: Surfaces outside the overlap.
NEUTRAL = "#d5d8da"
#: Signed distances: blue = farther from the sensor, red = nearer.
DIVERGING = ("#1f4e9c", "#7fa9d8", "#f4f3ee", "#e7a07c", "#a8251d")
INK, MUTED = "#22282d", "#6b757d"

diverging_map = LinearSegmentedColormap.from_list("overlap error", DIVERGING)


def colour(index: int) -> str:
    """Return the colour of a measurement."""
    return PALETTE[index % len(PALETTE)]


def rgb(code: str) -> NDArray[np.float64]:
    """Return (3,) in [0, 1] of "#rrggbb"."""
    return np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def png(figure: Figure, dpi: int = 144) -> bytes:
    """Return a figure as PNG."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    # No version or date in the file: the same figure gives the same bytes.
    figure.savefig(buffer, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def save_bytes(path: Path, content: bytes) -> None:
    """Write a file under a temporary name, then rename."""
    with storage.replacing(path) as temporary:
        temporary.write_bytes(content)


def nice_limit(values: Sequence[float], least: float = 0.01) -> float:
    """Return the smallest of 1, 2, 5 x 10^n that is at least the largest value and `least`."""
    largest = max([least, *[v for v in values if np.isfinite(v)]])
    power = 10.0 ** np.floor(np.log10(largest))
    return float(next(f * power for f in (1, 2, 5, 10) if f * power >= largest * (1 - 1e-9)))
