"""Reading pictures between their pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map

#: OpenCV's remap takes maps of fewer rows than 2^15; the places are laid out as a picture of this width.
_WIDTH = 1024


def sample(picture: Map, xy: Array | Map, nearest_outside: bool = False) -> Map:
    """Return the values (..., channels) of a picture at places (..., 2) (column, row), linearly interpolated.

    Beyond the picture stands 0, or the value of the nearest pixel.
    """
    places = np.asarray(xy, np.float32).reshape(-1, 2)
    shape = (*np.shape(xy)[:-1], *picture.shape[2:])
    if len(places) == 0:
        return np.empty(shape, np.float32)
    maps = np.zeros((-(-len(places) // _WIDTH) * _WIDTH, 2), np.float32)
    maps[: len(places)] = places
    border = cv2.BORDER_REPLICATE if nearest_outside else cv2.BORDER_CONSTANT
    drawn = cv2.remap(picture, maps.reshape(-1, _WIDTH, 2), None, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(drawn.reshape(len(maps), *picture.shape[2:])[: len(places)].reshape(shape))


def parabola_vertex(before: NDArray[np.floating], at: NDArray[np.floating], after: NDArray[np.floating]) -> Array:
    """Return where the parabola through three neighbouring values is highest, from the middle one [px], within half
    a pixel; 0 where it has no maximum.
    """
    bend = np.asarray(before, float) - 2 * np.asarray(at, float) + after
    # A bend of nothing: any small divisor does, the result is clipped or not taken.
    return np.asarray(np.where(bend < 0, 0.5 * (before - after) / np.minimum(bend, -1e-12), 0.0).clip(-0.5, 0.5))
