"""Do the textures agree where the consensus did not look?

The transform of the consensus predicts the whole common region. A grid of windows is laid over it, and each is
correlated with b's texture over a small search area: where the textures belong together, the peaks stand where the
transform says; where they do not, they stand anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial import cKDTree

from planish.geometry import Array
from planish.measurement import Map
from planish.options import thread_count
from planish.registration.texture.sampling import parabola_vertex, sample
from planish.registration.verdict.aligned import Aligned, Side, align
from planish.registration.verdict.together import Together
from planish.registration.verdict.window_sizes import VerifyOptions, size_px


@dataclass(frozen=True)
class Windows:
    """n windows of the common region that a transform predicts.

    Parameters
    ----------
    cell : ndarray (n,) int64
        Number of the window on the grid of a's texture images: the same place for every transform.
    points_a : ndarray (n, 3)
        Middle [mm], in the frame of a.
    pixels_a, pixels_b : ndarray (n, 2)
        Middle in both organising cameras.
    found_b : ndarray (n, 2)
        Pixel of b where the peak of the correlation puts the middle; NaN where b is not known there.
    offset_mm : ndarray (n, 2)
        Position of the correlation's peak in a's texture image, relative to what the transform predicts.
    score : ndarray (n,)
        Best correlation coefficient within `agree_mm` of the prediction, of the textures as the matched filter weighs
        their frequencies.
    agrees : ndarray (n,) bool
        Whether the peak lies within `agree_mm`.
    chance : float
        Share of the search area that counts as agreement.
    richness : ndarray (n,)
        Variance of both textures over that of their noise. Not what exceeds the noise: where texture is weak, the
        uncertainty of the noise would make all windows alike.
    together : Together
        How high the correlation is at every place of the search area, for the test of all windows in one.
    charts : tuple of Aligned
        Both textures, where all windows were cut from them; else none.
    """

    cell: NDArray[np.int64]
    points_a: Array = field(metadata={"unit": "mm"})
    pixels_a: Array = field(metadata={"unit": "px"})
    pixels_b: Array = field(metadata={"unit": "px"})
    found_b: Array = field(metadata={"unit": "px"})
    offset_mm: Array = field(metadata={"unit": "mm"})
    score: Array
    agrees: NDArray[np.bool_]
    chance: float
    richness: Array
    together: Together
    charts: tuple[Aligned, ...] = ()

    def __len__(self) -> int:
        return len(self.cell)

    @property
    def credible(self) -> NDArray[np.bool_]:
        """Which windows agree, and not only by chance: at least half as well as most that agree."""
        if not self.agrees.any():
            return self.agrees
        return np.asarray(self.agrees & (self.score >= 0.5 * np.median(self.score[self.agrees])))

    def take(self, index: NDArray[np.bool_]) -> Windows:
        """Return the windows at `index`."""
        common = ("chance", "together", "charts")
        own = {name: getattr(self, name)[index] for name in self.__dataclass_fields__ if name not in common}
        return Windows(**own, chance=self.chance, together=self.together.take(index))


def correlate_windows(a: Side, b: Side, T_a_b: Array, options: VerifyOptions | None = None, every: int = 1) -> Windows:
    """Return the windows of the common region under T_a_b, each with the peak of its correlation.

    Of the grid of windows, every so many along both axes are looked at.
    """
    options = options or VerifyOptions()
    window, search = size_px(a.images, options)
    pitch = a.images[0].pitch_mm if a.images else 1.0
    rows = np.arange(2 * search + 1) - search
    near = (rows[:, None] ** 2 + rows[None, :] ** 2 <= (options.agree_mm / pitch) ** 2).ravel()
    lattice_px = None if every == 1 else (every * window, window + 2 * search)
    charts = align(a, b, T_a_b, options.gate_mm, lattice_px)
    cut = [(number, part) for number, part in enumerate(_cut(c, options, every) for c in charts) if len(part.centre)]
    whole = charts if every == 1 else ()
    if not cut:
        return _no_windows(near, whole)
    value_a, value_b, noise = (np.concatenate([getattr(part, name) for _, part in cut]) for name in ("a", "b", "noise"))
    surface, unrelated, richness = _correlation(value_a, value_b, noise, window, search, thread_count(a.threads))
    flat = surface.reshape(len(surface), -1)
    peak = np.argmax(flat, 1)
    offset_px = _refined_peak(surface, peak, search)
    places, start = [], 0
    for number, part in cut:
        own = slice(start, start + len(part.centre))
        places.append(_places(charts[number], number, part.centre, offset_px[own], window))
        start = own.stop
    cell, points, pixels_a, pixels_b, found_b = (np.concatenate(x) for x in zip(*places, strict=True))
    return Windows(
        cell, points, pixels_a, pixels_b, found_b, offset_px * pitch, flat[:, near].max(1), near[peak],
        float(near.mean()), richness, Together.of(surface, unrelated, near), whole,
    )  # fmt: skip


def _no_windows(near: NDArray[np.bool_], charts: tuple[Aligned, ...]) -> Windows:
    none, pixels, heights = np.empty(0), np.empty((0, 2)), np.empty((0, len(near)), np.float32)
    return Windows(
        np.empty(0, np.int64), np.empty((0, 3)), pixels, pixels, pixels, pixels, none, np.empty(0, bool),
        float(near.mean()), none, Together(heights, heights, near), charts,
    )  # fmt: skip


def _refined_peak(surface: Array, peak: NDArray[np.intp], search: int) -> Array:
    """Place (n, 2) of the peaks (x, y) [texture px]: the vertex of a parabola along both axes."""
    reach = 2 * search + 1
    row, column = np.divmod(peak, reach)
    n = np.arange(len(peak))

    padded = np.pad(surface, ((0, 0), (1, 1), (1, 1)), mode="edge")
    cross = ((0, -1), (0, 1), (-1, 0), (1, 0))
    left, right, above, below = (padded[n, row + 1 + dr, column + 1 + dc] for dr, dc in cross)
    top = padded[n, row + 1, column + 1]
    return np.column_stack(
        [column - search + parabola_vertex(left, top, right), row - search + parabola_vertex(above, top, below)]
    )  # fmt: skip


def _places(
    chart: Aligned, number: int, centre: NDArray[np.int64], offset_px: Array, window: int
) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """Cell, point of a, pixels of a and b and pixel of b at the peak, per window of a chart."""
    image, (row, column) = chart.image, centre.T
    cell = ((number * _CELLS + row // window) * _CELLS + column // window).astype(np.int64)
    found = sample(chart.source_b, centre[:, ::-1] + offset_px, nearest_outside=True)
    return (
        cell,
        image.points_at(row, column),
        image.source_px[row, column].astype(float),
        chart.source_b[row, column].astype(float),
        found.astype(float),
    )


#: More windows than any chart has along an axis.
_CELLS = 100000


@dataclass(frozen=True)
class _Cut:
    """Windows (n, N, N) of a (0 outside the window itself) and b, the noise variance, the middle (row, column)."""

    a: Map
    b: Map
    noise: Array
    centre: NDArray[np.int64]


#: Robust deviations at which values are clipped, and by how much less than that is surely not clipped.
_CLIPPED, _SURELY_LESS = 12.0, 0.999
#: A window counts if it and its search area are known to this share.
_KNOWN = 0.8


def _cut(chart: Aligned, options: VerifyOptions, every: int) -> _Cut:
    window, search = size_px((chart.image,), options)
    size = window + 2 * search
    height, width = chart.common.shape
    rows, columns = (np.arange(search, n - window - search + 1, every * window) for n in (height, width))
    row, column = (x.ravel() for x in np.meshgrid(rows, columns, indexing="ij"))
    centre = np.column_stack([row, column]) + window // 2
    nothing = np.empty((0, size, size), np.float32)
    if len(row) == 0:
        return _Cut(nothing, nothing, np.empty((0, 2)), centre)
    at = (row - search, column - search)

    def windows(picture: NDArray[Any], select: NDArray[np.bool_] | slice = slice(None)) -> NDArray[Any]:
        return np.lib.stride_tricks.sliding_window_view(picture, (size, size))[at[0][select], at[1][select]]

    inner = np.s_[:, search : search + window, search : search + window]
    known = windows(chart.common)
    keep = (known.mean((1, 2)) >= _KNOWN) & (known[inner].mean((1, 2)) >= _KNOWN)
    keep &= chart.common[centre[:, 0], centre[:, 1]]
    known = known[keep]
    a = np.where(known, windows(chart.image.value, keep), np.float32(0))
    b = windows(chart.value_b, keep)
    noise = np.column_stack(
        [(windows(s, keep)[inner] ** 2).mean((1, 2)) for s in (chart.image.sigma, chart.sigma_b)]
    ) / np.maximum(known[inner].mean((1, 2)), _KNOWN)[:, None]  # fmt: skip
    # Marks are texture, but one speck must not rule a window.
    a, b = _clipped(a), _clipped(b)
    only = np.zeros_like(a)
    only[inner] = a[inner]
    return _Cut(only, b, noise, centre[keep])


def _clipped(values: Map) -> Map:
    """Clip windows (n, N, N) in place, and return them."""
    if len(values) == 0:
        return values
    size = np.abs(values)
    # Where more than half of a window exceed the limit of its greatest value, nothing is to be clipped: only the
    # others are sorted.
    most = size.max((1, 2), keepdims=True)
    strong = np.count_nonzero(size > most / np.float32(_CLIPPED * 1.4826 * _SURELY_LESS), axis=(1, 2))
    unsure = 2 * strong <= size[0].size
    if not unsure.any():
        return values
    limit = np.float32(_CLIPPED * 1.4826) * np.median(size[unsure], axis=(1, 2), keepdims=True)
    values[unsure] = np.clip(values[unsure], -limit, limit)
    return values


def _correlation(a: Map, b: Map, noise: Array, window: int, search: int, threads: int) -> tuple[Array, Array, Array]:
    """Matched filter of n windows over their search areas (n, 2 search + 1, 2 search + 1), as a coefficient.

    The second of the results is that of each window of a with another one of b: they have no texture in common.

    Weighted by signal over power of both spectra, S / (P_a P_b): the likelihood ratio of a common weak signal in
    coloured noise (Van Trees, Detection, Estimation and Modulation Theory I, section 4.3); the mean periodogram of all
    windows serves for P, and S is what of it the known noise of the cameras does not explain.
    """
    size = a.shape[1]
    F_a, F_b = (fft.rfft2(x, workers=threads) for x in (a, b))
    power_a = _smooth((np.abs(F_a) ** 2).mean(0)) / window**2
    power_b = _smooth((np.abs(F_b) ** 2).mean(0)) / size**2
    noise_a, noise_b = noise.mean(0)
    # Resampling takes noise away at high frequencies: a part of the power always counts as signal.
    signal = np.sqrt(
        np.maximum(power_a - noise_a, _LEAST_SIGNAL * power_a) * np.maximum(power_b - noise_b, _LEAST_SIGNAL * power_b)
    )
    floor_a, floor_b = (1e-3 * p.mean() + 1e-30 for p in (power_a, power_b))
    weight = signal / ((power_a + floor_a) * (power_b + floor_b))
    weight[0, 0] = 0.0
    weight = weight.astype(np.float32)
    # Shifts -search ... search: b's window begins `search` px before a's.
    index = np.arange(-search, search + 1)
    surface, unrelated = (
        fft.irfft2(np.conj(F_a) * other * weight, s=(size, size), workers=threads)[:, index[:, None], index[None, :]]
        for other in (F_b, np.roll(F_b, max(1, len(F_b) // 2), axis=0))
    )
    # Coefficient of the weighted textures; b's share of its whole window's energy is that of the area.
    twice = np.full(weight.shape, 2.0)
    twice[:, 0] = 1.0
    energy_a, energy_b = ((np.abs(F) ** 2 * (weight * twice)).sum((1, 2)) / size**2 for F in (F_a, F_b))
    surface /= (np.sqrt(energy_a * energy_b) * window / size)[:, None, None] + 1e-30
    variance = (a**2).sum((1, 2)) / window**2 * (b**2).mean((1, 2))
    return surface, unrelated, variance / np.maximum(noise.prod(1), 1e-30)


#: Share of the power that counts as signal at least.
_LEAST_SIGNAL = 0.03


def _smooth(power: Array) -> Array:
    """Power spectrum (N, N/2 + 1), averaged over neighbouring frequencies."""
    mean = sum(np.roll(power, shift, 0) for shift in (-1, 0, 1)) / 3
    padded = np.pad(mean, ((0, 0), (1, 1)), mode="edge")
    return np.asarray((padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]) / 3)


def apart_from(windows: Windows, points_a: Array, distance_mm: float) -> NDArray[np.bool_]:
    """Return which windows (n,) have none of `points_a` (M, 3) within `distance_mm` of their middle."""
    if len(points_a) == 0 or len(windows) == 0:
        return np.ones(len(windows), bool)
    distance, _ = cKDTree(points_a).query(windows.points_a)
    return np.asarray(distance > distance_mm)
