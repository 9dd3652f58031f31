"""Local contrast: the texture without what belongs to light, shape and sensor, with its noise.

A camera sees I = albedo * (projector's light * cos(incidence) / distance^2 + room light) + highlight. The projector's
part follows from the known geometry. What is left of fall-off, room light and exposure changes slowly over the surface
and follows from a low-pass. I / expected - 1 is the relative deviation of the albedo from its surroundings, whatever
the light. Highlights depend on the direction of view: where one camera is brighter than the other says, it counts less.
Image kinds (mean of the fringe images, white) and cameras are combined by their noise on the organising camera's grid;
the other camera is read at the measured correspondence.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.measurement import Map, Measurement
from planish.options import Options
from planish.registration.surface import Surface, fit_surface
from planish.registration.texture.shading import projector_shading
from planish.registration.tiles import ground_sample_distance


class PhotometricOptions(Options):
    """Options of the photometric compensation."""

    #: Scale above which a change of brightness counts as shading [mm] (standard deviation of the low-pass).
    shading_mm: float = Field(default=2.5, gt=0)
    #: Normals are averaged over this length for the shading, so that their noise does not become texture [mm].
    normal_mm: float = Field(default=3.0, gt=0)
    #: Local contrast is clipped here: beyond it, highlights and holes rule.
    max_contrast: float = Field(default=0.5, gt=0)
    #: Excess of one camera's brightness over the other's at which its weight has fallen to 1 / e.
    highlight_excess: float = Field(default=0.15, gt=0)


def local_contrast(
    measurement: Measurement,
    options: PhotometricOptions | None = None,
    surface: Surface | None = None,
    threads: int | None = None,
) -> tuple[Map, Map]:
    """Return the local contrast and its standard deviation on the organising camera's grid.

    `surface` is the measurement's own fit, computed where it is not given and a projector is known.

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
    shading_px, shading = options.shading_mm / gsd, None
    if measurement.rig.projector is not None:
        surface = surface or fit_surface(measurement, threads=threads)
        shading = projector_shading(measurement, surface, options.normal_mm)
    relative = None if shading is None else _over_lowpass(shading, shading_px)
    seen = [_on_organising_grid(measurement, name) for name in measurement.texture_views]
    parts = [_contrast(view, relative, shading_px, options.max_contrast) for view in seen]
    trust = _highlight_trust([level for _, _, level in parts], options.highlight_excess)
    weights = sum(weight * t for (_, weight, _), t in zip(parts, trust, strict=True))
    total = sum(value * weight * t for (value, weight, _), t in zip(parts, trust, strict=True))
    # Trust chooses between cameras; it is no noise, so that sigma follows from the weights that were used.
    noise = sum(weight * t * t for (_, weight, _), t in zip(parts, trust, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        known = (np.asarray(weights) > 0) & measurement.valid
        value = np.where(known, total / weights, np.float32(np.nan))
        sigma = np.where(known, np.sqrt(noise) / weights, np.float32(np.nan))
    return value.astype(np.float32), sigma.astype(np.float32)


@dataclass(frozen=True)
class _Seen:
    """One camera's images (H, W) on the organising grid: (image, variance of a pixel, saturation level) each."""

    mean: tuple[Map, Map] | None
    white: tuple[Map, Map] | None
    saturation: float


def _on_organising_grid(measurement: Measurement, name: str) -> _Seen:
    view = measurement.views[name]
    where = None if name == measurement.organised_on else measurement.correspondence_px
    assert where is not None or name == measurement.organised_on, "a second texture view needs the correspondence"

    def seen(image: Map | None, count: int) -> tuple[Map, Map] | None:
        if image is None:
            return None
        moved = image if where is None else _moved(image, where)
        return moved, view.noise.variance(moved) / np.float32(count)

    return _Seen(seen(view.mean, view.mean_images), seen(view.white, 1), view.saturation)


def _moved(image: Map, where: Map) -> Map:
    # Cubic: sharpness and noise stay nearly those of a pixel. NaN (no correspondence) falls outside and becomes NaN.
    u, v = (np.nan_to_num(np.ascontiguousarray(where[..., i]), nan=-1e4) for i in (0, 1))
    return cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))


def _contrast(view: _Seen, relative: Map | None, shading_px: float, limit: float) -> tuple[Map, Map, Map]:
    """Local contrast, weight (1 / variance, 0 where unknown) and brightness level of one camera, each (H, W)."""
    ambient = _ambient(view, shading_px)
    total, weights, level = None, None, None
    for pair, room_light in ((view.mean, ambient), (view.white, None)):
        if pair is None:
            continue
        image, variance = pair
        known = np.isfinite(image) & (image > 3 * np.sqrt(variance))
        if pair is view.white:
            known &= image < view.saturation
        smooth = _masked_lowpass(image, known, shading_px)
        expected = smooth if relative is None else _expected(smooth, relative, room_light)
        known &= np.isfinite(expected) & (expected > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.clip(image / expected - 1, -limit, limit)
            weight = np.where(known & np.isfinite(value), expected**2 / variance, np.float32(0))
        value = np.where(weight > 0, value, np.float32(0))
        total = weight * value if total is None else total + weight * value
        weights = weight if weights is None else weights + weight
        level = smooth if level is None else level
    if total is None or weights is None or level is None:
        raise AssertionError("a view has a mean or a white image")
    return (total / np.maximum(weights, np.float32(1e-30))).astype(np.float32), weights, level


def _ambient(view: _Seen, shading_px: float) -> Map | None:
    """Room light in the mean of the fringe images, slowly varying: mean = room light + half of white (less dark)."""
    if view.mean is None or view.white is None:
        return None
    both = np.isfinite(view.mean[0]) & np.isfinite(view.white[0]) & (view.white[0] < view.saturation)
    return _masked_lowpass(np.maximum(view.mean[0] - view.white[0] / 2, 0), both, shading_px)


def _expected(smooth: Map, relative: Map, ambient: Map | None) -> Map:
    """Brightness of an even albedo: the projector's part follows the geometry, the room's part does not.

    With I = albedo * S, lowpass(I) * S / lowpass(S) is S times the local mean of the albedo, weighted by S.
    """
    room = np.float32(0) if ambient is None else np.minimum(ambient, smooth)
    return (smooth - room) * relative + room


def _over_lowpass(shading: Map, shading_px: float) -> Map:
    known = np.isfinite(shading)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known, shading / _masked_lowpass(shading, known, shading_px), np.float32(np.nan))


def _highlight_trust(levels: list[Map], excess: float) -> list[Map]:
    """Weight factor (H, W) per camera: a matt surface is equally bright from everywhere, a highlight is not."""
    if len(levels) < 2:
        return [np.ones_like(level) for level in levels]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = [np.where(level > 0, np.log(level), np.float32(np.nan)) for level in levels]
    difference = logs[0] - logs[1]
    difference = (
        difference - np.nanmedian(difference[::8, ::8]) if np.isfinite(difference[::8, ::8]).any() else difference
    )
    difference = np.nan_to_num(difference, nan=0.0)
    return [np.exp(-((np.maximum(sign * difference, 0) / np.float32(excess)) ** 2)) for sign in (1, -1)]


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
