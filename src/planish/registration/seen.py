"""Where the points of one measurement stand in the image of another one, under a transform."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Measurement


def nearest_pixels(
    a: Measurement, b: Measurement, T_a_b: Array, stride: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], Array]:
    """Return some points of b that lie in a's image.

    Parameters
    ----------
    a, b : Measurement
    T_a_b : ndarray (4, 4)
    stride : int
        Every n-th pixel of b along both axes is looked at.

    Returns
    -------
    pixels_b, pixels_a : ndarray (n,) int32
        Flat index of the pixel of b, and of a's pixel that is nearest to where it lies.
    points_a : ndarray (n, 3)
        The points in frame a [mm].
    """
    pixels, points = _core.nearest_pixels(
        np.ascontiguousarray(b.points_sensor, np.float32), stride, a.camera.kernel_parameters, *a.shape,
        np.ascontiguousarray(T_a_b, float),
    )  # fmt: skip
    return pixels[:, 0], pixels[:, 1], points
