"""The picture of a measurement's texture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.evaluation.prepared import Prepared

#: Width of one texture image in the picture of the matches [px].
TEXTURE_PX = 640
#: Grey levels of the picture (texture is noise to the compressor: fewer levels, smaller file).
GREY_LEVELS = 24
#: Darkest and lightest grey of a texture: the lines must stand out.
DARK, LIGHT = 84, 236

Picture = NDArray[np.uint8]


def texture_picture(item: Prepared, width: int = TEXTURE_PX) -> Picture:
    """Return the local contrast as a grey picture (h, width), stretched to 4 robust standard deviations."""
    value = item.contrast[0]
    scale = width / value.shape[1]
    size = (width, max(1, round(value.shape[0] * scale)))
    known = np.isfinite(value)
    reduced = cv2.resize(np.where(known, value, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    with np.errstate(invalid="ignore", divide="ignore"):
        reduced = np.where(share > 0.5, reduced / share, np.nan)
    seen = reduced[np.isfinite(reduced)]
    spread = 1.4826 * float(np.median(np.abs(seen - np.median(seen)))) if len(seen) else 1.0
    level = np.rint((0.5 + reduced / (8 * max(spread, 1e-9))).clip(0, 1) * (GREY_LEVELS - 1)) / (GREY_LEVELS - 1)
    return np.where(np.isfinite(level), DARK + (LIGHT - DARK) * np.nan_to_num(level), 255).astype(np.uint8)
