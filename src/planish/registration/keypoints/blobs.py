"""Blobs of the texture that stand out of the known noise, spread evenly over the surface."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.texture.resample import TextureImage
from planish.registration.texture.sampling import parabola_vertex

#: Ratio of the two Gaussians whose difference finds blobs (Marr and Hildreth 1980: close to the Laplacian).
_RATIO = 1.6
#: Blobs are as far from the rim of the surface as this many scales: what ends there is no texture.
_RIM_SCALES = 1.5


@dataclass(frozen=True)
class SmoothTexture:
    """A texture image smoothed to one scale.

    Parameters
    ----------
    scale_px : float
        Standard deviation of the Gaussian [texture px].
    value : ndarray (h, w) float32
        Mean of the texture around each pixel, weighted by the Gaussian and by 1 / variance.
    significance : ndarray (h, w) float32
        Difference of two such means over its standard deviation by noise.
    mask : ndarray (h, w) bool
        Where the image holds texture.
    """

    scale_px: float
    value: Map
    significance: Map
    mask: NDArray[np.bool_]


@dataclass(frozen=True)
class Blobs:
    """Extrema of the significance: places xy (N, 2) [texture px] and how much they stand out (N,)."""

    xy: Array
    significance: Array


def smooth_texture(image: TextureImage, scale_px: float) -> SmoothTexture:
    """Return the texture smoothed to a scale [texture px]."""
    # A floor for the deviation: where none is stated, all pixels count the same.
    sigma = np.maximum(image.sigma, np.float32(1e-6))
    weight = np.where(image.mask, 1 / sigma**2, np.float32(0))
    fine, information = _weighted_mean(image.value, weight, scale_px)
    coarse, _ = _weighted_mean(image.value, weight, _RATIO * scale_px)
    # White noise of unit variance through g(s) - g(t) has the variance (1/s^2 + 1/t^2 - 4/(s^2 + t^2)) / 4 pi.
    s2, t2 = scale_px**2, (_RATIO * scale_px) ** 2
    gain = np.sqrt((1 / s2 + 1 / t2 - 4 / (s2 + t2)) / (4 * np.pi))
    significance = (fine - coarse) * np.sqrt(information) / np.float32(gain)
    return SmoothTexture(scale_px, fine, np.where(image.mask, significance, np.float32(0)), image.mask)


def find_blobs(texture: SmoothTexture, min_significance: float) -> Blobs:
    """Return the extrema, bright and dark, away from the rim of the surface."""
    strength = np.abs(texture.significance)
    peak = strength >= cv2.dilate(strength, _disc(texture.scale_px))
    rim = cv2.erode(texture.mask.astype(np.uint8), _disc(_RIM_SCALES * texture.scale_px), borderValue=0)
    row, column = np.nonzero(peak & (rim > 0) & (strength > min_significance))
    return Blobs(_refined(strength, row, column), strength[row, column].astype(float))


def spread_evenly(blobs: Blobs, cell_px: float) -> NDArray[np.intp]:
    """Return the order (N,) in which to take blobs: the strongest of every cell first, then the second of every cell.

    So a region of strong texture gets no more than its share, as long as there are others.
    """
    x, y = blobs.xy.T
    strong_first = np.lexsort((x, y, -blobs.significance))
    cell = (np.floor(y / cell_px) * 1e6 + np.floor(x / cell_px))[strong_first]
    by_cell = np.argsort(cell, kind="stable")
    ordered = cell[by_cell]
    first = np.searchsorted(ordered, ordered)
    rank = np.empty(len(cell), np.intp)
    rank[by_cell] = np.arange(len(cell)) - first
    return strong_first[np.argsort(rank, kind="stable")]


def _weighted_mean(value: Map, weight: Map, scale_px: float) -> tuple[Map, Map]:
    """Gaussian mean of the known pixels (normalised convolution, Knutsson and Westin 1993), and the mean weight."""

    def smooth(image: Map) -> Map:
        return cv2.GaussianBlur(image, (0, 0), scale_px, borderType=cv2.BORDER_CONSTANT)

    density = smooth(weight)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(density > 0, smooth(weight * value) / density, np.float32(0)), density


def _disc(radius_px: float) -> NDArray[np.uint8]:
    size = 2 * max(1, round(radius_px)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def _refined(strength: Map, row: NDArray[np.intp], column: NDArray[np.intp]) -> Array:
    """Places (N, 2) of the maxima to fractions of a pixel: a parabola through three pixels along each axis."""
    # The rim of the surface keeps maxima away from the picture's own rim.
    at = strength[row, column]
    x = column + parabola_vertex(strength[row, column - 1], at, strength[row, column + 1])
    y = row + parabola_vertex(strength[row - 1, column], at, strength[row + 1, column])
    return np.column_stack([x, y]).astype(float)
