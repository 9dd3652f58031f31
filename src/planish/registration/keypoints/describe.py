"""Descriptors: the smoothed texture around a keypoint in its own frame, in whole numbers.

Linear on purpose: the squared distance of two descriptors is 2 - 2 times the correlation of what they describe. Where a
pixel holds more noise than texture, histograms of gradients would add up the noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.keypoints.blobs import SmoothTexture
from planish.registration.texture.sampling import sample

#: Values of a descriptor.
LENGTH = 128
#: Deviation of the Gaussian that weights the neighbourhood, in multiples of its radius.
_WEIGHT_DEVIATION = 0.6
#: Steps per unit of the normalised values, about the middle of a byte: half of the whole length fits into one value.
_STEPS, _MIDDLE = 256.0, 128.0


def describe(texture: SmoothTexture, xy: Array, angle: Array, support_scales: float) -> NDArray[np.uint8]:
    """Return the descriptors (N, 128) of places (N, 2) [texture px] with their orientations (N,) [rad]."""
    x, y, weight = _pattern(support_scales)
    along, across = (x * np.float32(texture.scale_px), y * np.float32(texture.scale_px))
    cosine, sine = (f(angle)[:, None].astype(np.float32) for f in (np.cos, np.sin))
    columns = xy[:, :1].astype(np.float32) + cosine * along - sine * across
    rows = xy[:, 1:].astype(np.float32) + sine * along + cosine * across
    places = np.stack([columns, rows], -1)
    known, value = sample(texture.mask.astype(np.float32), places), sample(texture.value, places)
    share = known * weight
    mean = (value * share).sum(1, keepdims=True) / np.maximum(share.sum(1, keepdims=True), np.float32(1e-6))
    value = (value - mean) * known * np.sqrt(weight)
    norm = np.sqrt((value**2).sum(1, keepdims=True))
    unit = value / np.where(norm > 0, norm, np.float32(1))
    return np.rint(_MIDDLE + _STEPS * unit).clip(0, 255).astype(np.uint8)


def _pattern(support_scales: float) -> tuple[Map, Map, Map]:
    """Offsets (128,) of the samples in multiples of the scale, and their weights: a square grid cut to a disc."""
    # So many points of a square grid lie in the disc if its spacing is radius * sqrt(pi / n).
    spacing = support_scales * np.sqrt(np.pi / LENGTH)
    reach = int(np.ceil(support_scales / spacing)) + 1
    x, y = (m.ravel() for m in np.meshgrid(*2 * (np.arange(-reach, reach + 1) * spacing,)))
    nearest = np.lexsort((x, y, np.round(np.hypot(x, y), 6)))[:LENGTH]
    x, y = x[nearest], y[nearest]
    weight = np.exp(-(x**2 + y**2) / (2 * (_WEIGHT_DEVIATION * support_scales) ** 2))
    return x.astype(np.float32), y.astype(np.float32), weight.astype(np.float32)
