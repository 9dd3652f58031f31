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
#: Most rivals that are tried.
_MAX_RIVALS = 3
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
    found: list[tuple[float, Array]] = []
    own = 0.0
    for quarter in range(4):
        turn = translation(middle) @ compose(exp_so3([0, 0, quarter * np.pi / 2]), np.zeros(3)) @ translation(-middle)
        surface = _phase_correlation(F_a, _canvas(b, turn @ into_a, pitch, size))
        reach = max(1, round(apart_mm / pitch))
        if quarter == 0:
            around = np.roll(surface, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
            own = float(around.max())
            for rows in (np.s_[: reach + 1], np.s_[-reach:]):
                for columns in (np.s_[: reach + 1], np.s_[-reach:]):
                    surface[rows, columns] = -np.inf
        for _ in range(2):
            row, column = np.unravel_index(int(np.argmax(surface)), surface.shape)
            height = float(surface[row, column])
            shift = [(int(n) + size // 2) % size - size // 2 for n in (column, row)]
            moved = translation([shift[0] * pitch, shift[1] * pitch, 0.0]) @ turn @ into_a
            found.append((height, moved))
            surface[np.ix_(*(np.arange(n - reach, n + reach + 1) % size for n in (row, column)))] = -np.inf
    found.sort(key=lambda item: -item[0])
    T_sensor_chart = invert(a.T_chart_sensor)
    return [
        T_sensor_chart @ moved @ b.T_chart_sensor
        for height, moved in found[:_MAX_RIVALS]
        if own > 0 and height >= _MIN_SHARE * own
    ]


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
