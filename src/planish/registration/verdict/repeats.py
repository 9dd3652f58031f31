"""Where else would the texture fit: shifts by a period, quarter and half turns.

The consensus cannot be asked for them: of places that look alike, mutual nearest neighbours keep one. So b's texture,
as the transform lays it on a texture image of a, is correlated with that image over all shifts, as it is and turned by
90, 180 and 270 degrees; other peaks than the transform's own become rivals.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from planish.geometry import Array, fit_rigid, transform_points
from planish.measurement import Map
from planish.options import thread_count
from planish.registration.verdict.aligned import Aligned

#: Rivals whose peak is lower than this share of the transform's own explain less than a window test could tell.
_MIN_SHARE = 0.3
#: Repetitions differ in height by how much of the texture they still share.
_COMPARABLE = 0.5
#: Most peaks that are looked at, and rivals that are tried, per quarter turn.
_MAX_PEAKS, _MAX_RIVALS_PER_TURN = 24, 2
#: Images are reduced to at most this many pixels a side: a pattern that repeats is coarser than the grain.
_MAX_SIDE_PX = 384
#: Every so many pixels along both axes tell how large values are.
_SPARSE = 3
#: Places that a rival is fitted to, at most and at least.
_PLACES, _MIN_PLACES = 400, 12


def rival_transforms(
    charts: Sequence[Aligned], T_a_b: Array, apart_mm: float, gate_mm: float, threads: int | None = None
) -> list[Array]:
    """Return other transforms (4, 4) under which the textures correlate nearly as well, at least `apart_mm` away.

    Asked of the texture image that holds most of the common region; `charts` are those that T_a_b, or nearly that, puts
    both textures on. A shift or turn in the picture that no rigid motion makes within `gate_mm`, the surface being bent
    otherwise there, is none.
    """
    chart = max(charts, key=lambda c: int(c.common.sum()), default=None)
    if chart is None or chart.common.sum() < _MIN_PLACES:
        return []
    step = max(1, -(-max(chart.common.shape) // _MAX_SIDE_PX))
    count = thread_count(threads)
    size = fft.next_fast_len(2 * -(-max(chart.common.shape) // step))
    F_a = fft.rfft2(
        _drawn(_smoothed(chart.image.value, chart.image.mask, step), np.eye(2, 3) / step, size), workers=count
    )
    value_b = _smoothed(chart.value_b, chart.common, step)
    reach = max(1, round(apart_mm / (chart.image.pitch_mm * step)))
    middle = _middle(chart.common)
    chosen: list[Array] = []
    own = 0.0
    for quarter in range(4):
        turn = _turned(quarter, middle)
        surface = _correlation(F_a, _drawn(value_b, turn / step, size), count)
        if quarter == 0:
            own = _taken_out(surface, 0, 0, reach)
        if own <= 0:
            return []
        peaks = _peaks(surface, reach, _MIN_SHARE * own)
        # Of a lattice of repetitions the nearest tells the period; of turned ones the best fit counts.
        peaks.sort(key=lambda peak: float(np.hypot(*peak[1])) if quarter == 0 else -peak[0])
        for _, shift in peaks[:_MAX_RIVALS_PER_TURN]:
            motion = as_rigid_motion(chart, turn + np.column_stack([np.zeros((2, 2)), np.array(shift) * step]), gate_mm)
            if motion is not None:
                chosen.append(motion @ T_a_b)
    return chosen


def _middle(mask: NDArray[np.bool_]) -> Array:
    """Mean place (column, row) of the pixels of a mask."""
    counts = [np.count_nonzero(mask, axis) for axis in (0, 1)]
    return np.array([np.arange(len(n)) @ n / n.sum() for n in counts])


def _turned(quarter: int, middle: Array) -> Array:
    """Affine map (2, 3) that turns a picture by quarters of a turn about a place (column, row)."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    R = np.array([[cosine, -sine], [sine, cosine]], float)
    return np.column_stack([R, middle - R @ middle])


def _smoothed(value: Map, known: NDArray[np.bool_], step: int) -> Map:
    """A texture (h, w) without what stands out, smoothed so far that every `step`-th pixel says it all."""
    some = value[::_SPARSE, ::_SPARSE][known[::_SPARSE, ::_SPARSE]]
    limit = 4 * 1.4826 * float(np.median(np.abs(some))) if len(some) else 0.0
    clipped = np.clip(value, -limit, limit)
    return np.asarray(cv2.GaussianBlur(clipped, (0, 0), 0.5 * step) if step > 1 else clipped)


def _drawn(value: Map, A: Array, size: int) -> Map:
    """The picture (size, size) that the affine map A (2, 3) makes of a texture."""
    return np.asarray(cv2.warpAffine(value, A, (size, size), flags=cv2.INTER_LINEAR), np.float32)


def _correlation(F_a: Array, b: Map, threads: int) -> Map:
    """Correlation over all shifts of b; half whitened, so that fine grain and coarse print both count."""
    cross = F_a * np.conj(fft.rfft2(b, workers=threads))
    cross /= np.sqrt(np.abs(cross)) + 1e-12
    cross[0, 0] = 0
    return np.asarray(fft.irfft2(cross, s=b.shape, workers=threads), np.float32)


def _peaks(surface: Map, reach: int, lowest: float) -> list[tuple[float, tuple[int, int]]]:
    """Highest peaks (height, shift (x, y)) that compare with the highest of them; they are taken out."""
    size = len(surface)
    found: list[tuple[float, tuple[int, int]]] = []
    for _ in range(_MAX_PEAKS):
        row, column = (int(n) for n in np.unravel_index(int(np.argmax(surface)), surface.shape))
        height = _taken_out(surface, row, column, reach)
        if height < lowest or (found and height < _COMPARABLE * found[0][0]):
            break
        shift = [(n + size // 2) % size - size // 2 for n in (column, row)]
        found.append((height, (shift[0], shift[1])))
    return found


def _taken_out(surface: Map, row: int, column: int, reach: int) -> float:
    """Maximum within `reach` of a place of the periodic surface; what lies there is taken out."""
    around = np.ix_(*(np.arange(n - reach, n + reach + 1) % len(surface) for n in (row, column)))
    height = float(surface[around].max())
    surface[around] = -np.inf
    return height


def as_rigid_motion(chart: Aligned, A: Array, gate_mm: float) -> Array | None:
    """Return the rigid motion (4, 4) of a's surface that moves the common region as the affine map A (2, 3) moves its
    picture, or None where none does within `gate_mm`.
    """
    rows, columns = np.nonzero(chart.common)
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), _PLACES)).astype(int)
    rows, columns = rows[chosen], columns[chosen]
    to_column, to_row = np.rint(A @ np.vstack([columns, rows, np.ones(len(rows))])).astype(int)
    height, width = chart.common.shape
    inside = (to_column >= 0) & (to_column < width) & (to_row >= 0) & (to_row < height)
    inside[inside] &= chart.image.mask[to_row[inside], to_column[inside]]
    if inside.sum() < _MIN_PLACES:
        return None
    before = chart.image.points_at(rows[inside], columns[inside])
    after = chart.image.points_at(to_row[inside], to_column[inside])
    motion = fit_rigid(after, before)
    residual = np.linalg.norm(transform_points(motion, before) - after, axis=1)
    return motion if np.sqrt((residual**2).mean()) <= gate_mm else None
