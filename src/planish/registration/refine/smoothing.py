"""Gaussian averages over many pixels, from fewer samples."""

from __future__ import annotations

import cv2
import numpy as np

from planish.measurement import Map

#: Samples per standard deviation: linear interpolation between them errs by less than 1 / (8 * 4^2) of what is smooth.
_SAMPLES = 4


def smooth_map(image: Map, rows_px: float, columns_px: float) -> Map:
    """Return the Gaussian average of an image (H, W) with these standard deviations along both axes; 0 lies outside.

    Each sample stands for a square of pixels. What the square and the interpolation between samples add to the
    variance is taken from the Gaussian's.
    """
    height, width = image.shape
    step = max(1, int(min(rows_px, columns_px) / _SAMPLES))
    if step == 1:
        return cv2.GaussianBlur(image, (0, 0), columns_px, sigmaY=rows_px, borderType=cv2.BORDER_CONSTANT)
    # A square more on all sides: the rim, too, lies between samples.
    below, right = (step + -n % step for n in image.shape)
    whole = cv2.copyMakeBorder(image, step, below, step, right, cv2.BORDER_CONSTANT, value=0.0)
    size = whole.shape[1] // step, whole.shape[0] // step
    # A square has a variance of (step^2 - 1) / 12, the triangle of the interpolation of (step^2 - 1) / 6.
    added = (step**2 - 1) / 4
    rows, columns = (float(np.sqrt(sigma**2 - added)) / step for sigma in (rows_px, columns_px))
    squares = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(squares, (0, 0), columns, sigmaY=rows, borderType=cv2.BORDER_CONSTANT)
    smooth = cv2.resize(smooth, whole.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return smooth[step : step + height, step : step + width]
