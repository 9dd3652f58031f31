"""All windows in one: is their summed correlation highest where the transform says?

Where texture is weak, the peak of a single window stands anywhere, but the sum of all correlations still rises at the
right place: with the root of the windows' number, while peaks that agree are counted only where they win.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from planish.geometry import Array
from planish.measurement import Map


@dataclass(frozen=True)
class Together:
    """How high n windows correlate at each of the k places of their search area.

    Parameters
    ----------
    heights : ndarray (n, k) float32
        Normal score of the correlation's rank among all places of the window: standard normal under chance, whatever
        the texture is like.
    unrelated : ndarray (n, k) float32
        The same of each window with the texture of another one.
    near : ndarray (k,) bool
        Places that count as agreement.
    """

    heights: Map
    unrelated: Map
    near: NDArray[np.bool_]

    @classmethod
    def of(cls, surface: Array, unrelated: Array, near: NDArray[np.bool_]) -> Together:
        """Rank the correlations (n, rows, columns) of windows with what belongs to them, and with what does not."""
        return cls(_normal_scores(surface), _normal_scores(unrelated), near)

    def take(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> Together:
        """Return those of the windows at `index`."""
        return Together(self.heights[index], self.unrelated[index], self.near)

    def log10_chance(self) -> float:
        """Return log10 of the chance that the sum of the windows is as high at a place of agreement.

        Of windows that have nothing to do with each other the scores at one place are independent, and the sum has
        less than normal tails: P(sum >= z sqrt(n)) <= exp(-z^2 / 2) (Chernoff), times the places asked. Where textures
        are alike over more than a window (lines, streaks, patterns), windows are not independent: the variance of the
        sum of unrelated windows, over the places, says how much. A sum that is higher elsewhere speaks for nothing.
        """
        n = len(self.heights)
        if n == 0 or not self.near.any():
            return 0.0
        total = self.heights.sum(0, dtype=float) / np.sqrt(n)
        z = float(total[self.near].max())
        if z < total.max() or z <= 0:
            return 0.0
        dispersion = max(1.0, float((self.unrelated.sum(0, dtype=float) ** 2).mean() / n))
        return float(min(0.0, -(z**2) / (2 * dispersion * np.log(10)) + np.log10(self.near.sum())))


def _normal_scores(surface: Array) -> Map:
    """Normal scores (n, k) of the ranks within each window.

    The mean of a standard normal variable within its quantile: by Jensen's inequality no convex function of the score
    has a greater mean than that of the variable itself, so that the bounds of normal tails hold.
    """
    n, k = len(surface), int(np.prod(surface.shape[1:]))
    edges = ndtri(np.arange(k + 1) / k)
    density = np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi)
    scores = (k * (density[:-1] - density[1:])).astype(np.float32)
    # Sorted as whole numbers that differ all, the place behind the height: of those no sort can tell ties otherwise.
    bits = (np.asarray(surface.reshape(n, k), np.float32) + np.float32(0)).view(np.int32)
    keys = (bits ^ (bits >> 31 & 0x7FFFFFFF)).astype(np.int64) * 2**32 + np.arange(k)
    keys.sort(axis=1)
    heights = np.empty((n, k), np.float32)
    np.put_along_axis(heights, keys & 0xFFFFFFFF, np.broadcast_to(scores, (n, k)), axis=1)
    return heights
