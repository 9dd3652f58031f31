"""Where else would the texture fit: shifts by a period, quarter and half turns.

The consensus cannot be asked for them: of places that look alike, mutual nearest neighbours keep one. So b's chart, as
the transform lays it on a's, is correlated with a's chart over all shifts, as it is and turned by 90, 180 and 270
degrees; other peaks than the transform's own become rivals.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import fft

from planish.geometry import Array, compose, exp_so3, invert, translation
from planish.measurement import Map
from planish.registration.texture.resample import TextureImage
from planish.registration.verdict.aligned import compose_chart

#: Rivals whose peak is lower than this share of the transform's own explain less than a window test could tell.
_MIN_SHARE = 0.3
#: Repetitions differ in height by how much of the texture they still share.
_COMPARABLE = 0.5
#: Most peaks that are looked at, and rivals that are tried, per quarter turn.
_MAX_PEAKS, _MAX_RIVALS_PER_TURN = 24, 2
#: Charts are reduced to at most this many pixels a side: a pattern that repeats is coarser than the grain.
_MAX_SIDE_PX = 384


def rival_transforms(
    images_a: tuple[TextureImage, ...], images_b: tuple[TextureImage, ...], T_a_b: Array, apart_mm: float
) -> list[Array]:
    """Return other transforms (4, 4) under which the charts correlate nearly as well, at least `apart_mm` away.

    Asked of the largest chart of each: shifts and turns in its plane. Where the surface is not flat, what the windows
    say later decides whether they are possible.
    """
    if not images_a or not images_b:
        return []
    a, b = (max(images, key=lambda i: int(i.mask.sum())) for images in (images_a, images_b))
    step = max(1, -(-max(*a.mask.shape, *b.mask.shape) // _MAX_SIDE_PX))
    pitch = a.pitch_mm * step
    size = 2 * max(-(-n // step) for n in (*a.mask.shape, *b.mask.shape))
    size = fft.next_fast_len(int(size))
    canvas_a = _canvas(a, np.eye(4), pitch, size)
    into_a = invert(compose_chart(b, T_a_b, a))
    middle = _middle(b, into_a)
    F_a = fft.rfft2(canvas_a)
    reach = max(1, round(apart_mm / pitch))
    chosen: list[tuple[float, float, Array]] = []
    own = 0.0
    for quarter in range(4):
        turn = translation(middle) @ compose(exp_so3([0, 0, quarter * np.pi / 2]), np.zeros(3)) @ translation(-middle)
        surface = _phase_correlation(F_a, _canvas(b, turn @ into_a, pitch, size))
        if quarter == 0:
            own = float(_taken_out(surface, 0, 0, reach))
        peaks = _peaks(surface, reach, _MIN_SHARE * own) if own > 0 else []
        found = [
            (height, float(np.hypot(*shift)), translation([shift[0] * pitch, shift[1] * pitch, 0.0]) @ turn @ into_a)
            for height, shift in peaks
        ]
        # Of a lattice of repetitions the nearest tells the period; of turned ones the best fit counts.
        chosen += sorted(found, key=lambda item: item[1] if quarter == 0 else -item[0])[:_MAX_RIVALS_PER_TURN]
    T_sensor_chart = invert(a.T_chart_sensor)
    return [T_sensor_chart @ moved @ b.T_chart_sensor for _, _, moved in chosen]


def _peaks(surface: Map, reach: int, lowest: float) -> list[tuple[float, tuple[int, int]]]:
    """Highest peaks (height, shift (x, y)) that stand out from the highest of them; takes them out of the surface."""
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


def _canvas(image: TextureImage, T_canvas_chart: Array, pitch_mm: float, size: int) -> Map:
    """The chart (size, size) as T_canvas_chart lays it on a canvas of its pitch; 0 where unknown."""
    factor = image.pitch_mm / pitch_mm
    A = np.column_stack([T_canvas_chart[:2, :2] * factor, T_canvas_chart[:2, 3] / pitch_mm])
    value = image.value
    if factor < 1:
        value = cv2.GaussianBlur(value, (0, 0), 0.5 / factor)
    limit = 4 * 1.4826 * float(np.median(np.abs(value[image.mask]))) if image.mask.any() else 0.0
    drawn = cv2.warpAffine(
        np.clip(value, -limit, limit), A, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    return np.asarray(drawn, np.float32)


def _middle(image: TextureImage, T_canvas_chart: Array) -> Array:
    row, column = (n.mean() for n in np.nonzero(image.mask))
    at = T_canvas_chart @ np.array([column * image.pitch_mm, row * image.pitch_mm, 0.0, 1.0])
    return np.asarray(at[:3])


def _phase_correlation(F_a: Array, b: Map) -> Map:
    F_b = fft.rfft2(b)
    cross = np.conj(F_b) * F_a
    # Half whitened: fine grain and coarse print both count.
    cross /= np.sqrt(np.abs(cross)) + 1e-12
    cross[0, 0] = 0
    return np.asarray(fft.irfft2(cross, s=b.shape), np.float32)
