"""The distribution of a pair's overlap errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from matplotlib.figure import Figure

from planish.geometry import Array
from planish.measurement import Map
from planish.report.style import INK, MUTED, colour, png


@dataclass(frozen=True)
class Histogram:
    """Counts (n,) between edges (n + 1,) [mm], and the ends of the middle 95 % (2,) [mm]; all empty without values."""

    counts: Array
    edges: Array
    quantiles: Array

    @classmethod
    def of(cls, distance_mm: Map) -> Self:
        """Return the histogram of the finite values of a map (H, W) [mm]."""
        values = distance_mm[np.isfinite(distance_mm)]
        if not len(values):
            return cls(np.empty(0), np.empty(0), np.empty(0))
        limit = max(float(np.quantile(np.abs(values), 0.998)) * 1.15, 1e-3)
        counts, edges = np.histogram(values, bins=101, range=(-limit, limit))
        return cls(counts / len(values), edges, np.quantile(values, [0.025, 0.975]))


def histogram_png(histogram: Histogram, index_b: int) -> bytes:
    """Return the histogram of the signed distances of one pair as PNG."""
    figure = Figure(figsize=(4.6, 2.5), layout="constrained")
    axis = figure.add_subplot()
    if len(histogram.counts):
        axis.stairs(histogram.counts * 100, histogram.edges, fill=True, color=colour(index_b), alpha=0.85)
        axis.axvline(0, color=INK, linewidth=0.8)
        for quantile in histogram.quantiles:
            axis.axvline(float(quantile), color=MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
        axis.set_xlim(histogram.edges[0], histogram.edges[-1])
    axis.set_xlabel("signed distance [mm] (dashed: 95 % of the points)", fontsize=8, color=MUTED)
    axis.set_ylabel("points [%]", fontsize=8, color=MUTED)
    axis.tick_params(labelsize=8, colors=MUTED)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    return png(figure)
