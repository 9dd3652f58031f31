"""Local contrast: the texture without what belongs to light, shape and sensor, with its noise.

A camera sees I = albedo * shading + highlight. Fall-off, incidence, room light and exposure change slowly over the
surface, so I / lowpass(I) - 1 is the relative deviation of the albedo from its surroundings, whatever the light. It is
computed per image kind (white, mean of the fringe images) and per camera on that camera's own grid, brought to the
organising camera's grid by the measured correspondence, and combined by noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.measurement import Map, Measurement, View
from planish.options import Options
from planish.registration.tiles import ground_sample_distance


class PhotometricOptions(Options):
    """Options of the photometric compensation."""

    #: Scale above which a change of brightness counts as shading [mm] (standard deviation of the low-pass).
    shading_mm: float = Field(default=2.5, gt=0)
    #: Local contrast is clipped here: beyond it, highlights and holes rule.
    max_contrast: float = Field(default=0.5, gt=0)


def local_contrast(measurement: Measurement, options: PhotometricOptions | None = None) -> tuple[Map, Map]:
    """Return the local contrast and its standard deviation on the organising camera's grid.

    Returns
    -------
    value : ndarray (H, W) float32
        Relative deviation of the albedo from its surroundings, zero mean; NaN where unknown.
    sigma : ndarray (H, W) float32
        Its standard deviation from camera noise.
    """
    options = options or PhotometricOptions()
    gsd = ground_sample_distance(measurement)
    if not np.isfinite(gsd):
        nothing = np.full(measurement.shape, np.nan, np.float32)
        return nothing, nothing.copy()
    shading_px = options.shading_mm / gsd
    total = np.zeros(measurement.shape, np.float32)
    weights = np.zeros(measurement.shape, np.float32)
    for name in measurement.texture_views:
        value, weight = _view_contrast(measurement.views[name], shading_px, options.max_contrast)
        if name != measurement.organised_on:
            value, weight = _to_organising_grid(measurement, value, weight)
        total += weight * value
        weights += weight
    with np.errstate(divide="ignore", invalid="ignore"):
        known = (weights > 0) & measurement.valid
        value = np.where(known, total / weights, np.float32(np.nan))
        sigma = np.where(known, 1 / np.sqrt(weights), np.float32(np.nan))
    return value, sigma


def _view_contrast(view: View, shading_px: float, limit: float) -> tuple[Map, Map]:
    """Local contrast and weight (1 / variance, 0 where unknown), each (H, W), on the view's own grid."""
    total: Map | None = None
    weights: Map | None = None
    for image, count in ((view.mean, view.mean_images), (view.white, 1)):
        if image is None:
            continue
        variance = view.noise.variance(image) / count
        known = np.isfinite(image) & (image > 3 * np.sqrt(variance))
        if count == 1:
            known &= image < view.saturation
        smooth = _masked_lowpass(image, known, shading_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.clip(image / smooth - 1, -limit, limit)
            weight = np.where(known & (smooth > 0), smooth**2 / variance, 0).astype(np.float32)
        value = np.where(weight > 0, value, 0).astype(np.float32)
        total = weight * value if total is None else total + weight * value
        weights = weight if weights is None else weights + weight
    assert total is not None, "a view has at least one image"
    assert weights is not None
    return np.where(weights > 0, total / np.maximum(weights, 1e-30), 0).astype(np.float32), weights


#: The low-pass is computed on an image reduced so far that its deviation is this many pixels: it has no finer detail.
_REDUCED_SIGMA_PX = 2.0


def _masked_lowpass(image: Map, known: NDArray[np.bool_], sigma_px: float) -> Map:
    """Gaussian low-pass over the known pixels only (normalised convolution, Knutsson and Westin 1993); 0 where none."""
    height, width = image.shape
    factor = max(1, round(sigma_px / _REDUCED_SIGMA_PX))
    size = (max(1, round(width / factor)), max(1, round(height / factor)))

    def lowpass(values: Map) -> Map:
        reduced = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        scale = (sigma_px * size[0] / width, sigma_px * size[1] / height)
        return cv2.GaussianBlur(reduced, (0, 0), scale[0], sigmaY=scale[1], borderType=cv2.BORDER_CONSTANT)

    density = lowpass(known.astype(np.float32))
    smooth = lowpass(np.where(known, image, np.float32(0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(density > 1e-3, smooth / density, np.float32(0))
    return cv2.resize(ratio, (width, height), interpolation=cv2.INTER_CUBIC)


def _to_organising_grid(measurement: Measurement, value: Map, weight: Map) -> tuple[Map, Map]:
    assert measurement.correspondence_px is not None, "a second texture view needs the correspondence"
    where = measurement.correspondence_px
    u, v = np.ascontiguousarray(where[..., 0]), np.ascontiguousarray(where[..., 1])
    known = np.isfinite(u) & np.isfinite(v)
    u, v = np.where(known, u, -1e4), np.where(known, v, -1e4)
    moved = cv2.remap(value, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    weight = cv2.remap(weight, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return moved, np.where(known, weight, 0).astype(np.float32)
