"""Gaussian averages over many pixels, from fewer samples."""

from __future__ import annotations

import cv2
import numpy as np

from planish import _core
from planish.measurement import Map
from planish.registration.texture.lowpass import bell

#: Samples per standard deviation at least: linear interpolation between them errs by less than 1 / (8 * 2^2) of what
#: is smooth.
_SAMPLES = 2
#: Reach of the Gaussian, in standard deviations.
_REACH = 4.0


def smooth_map(image: Map, rows_px: float, columns_px: float) -> Map:
    """Return the Gaussian average of an image (H, W) with these standard deviations along both axes; 0 lies outside.

    What the interpolation between samples adds to the variance is taken from the Gaussian's.
    """
    height, width = image.shape
    fewest = int(min(rows_px, columns_px) / _SAMPLES)
    # An odd number, so that samples lie on pixels.
    step = max(1, fewest - (fewest + 1) % 2)
    if step == 1:
        return cv2.GaussianBlur(image, (0, 0), columns_px, sigmaY=rows_px, borderType=cv2.BORDER_CONSTANT)
    # The triangle of the interpolation has a variance of (step^2 - 1) / 6.
    sigmas = [float(np.sqrt(sigma**2 - (step**2 - 1) / 6)) for sigma in (columns_px, rows_px)]
    reach = int(np.ceil(_REACH * max(sigmas)))
    bells = [bell(sigma, reach).tolist() for sigma in sigmas]
    # The rim, too, lies between samples.
    shape = 1 + -(-(height - 1) // step), 1 + -(-(width - 1) // step)
    (samples,) = _core.window_moments(np.ascontiguousarray(image), bells, [(0, 1)], step, shape, 1)
    whole = cv2.resize(samples, (shape[1] * step, shape[0] * step), interpolation=cv2.INTER_LINEAR)
    return whole[step // 2 : step // 2 + height, step // 2 : step // 2 + width]
