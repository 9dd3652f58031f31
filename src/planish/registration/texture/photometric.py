"""Local contrast: the texture without what belongs to light, shape and sensor, with its noise.

A camera sees I = albedo * (projector's light * cos(incidence) / distance^2 + room light) + highlight. The projector's
part follows from the known geometry. What is left of fall-off, room light and exposure changes slowly over the surface
and follows from a low-pass. I / expected - 1 is the relative deviation of the albedo from its surroundings, whatever
the light. What is fixed to the camera's pixels is known from the run's other captures. Highlights depend on the
direction of view: where one camera is brighter than the other says, it counts less. Cameras are combined by their noise
on the organising camera's grid; the other camera is read at the measured correspondence.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from pydantic import Field

from planish import _core
from planish.measurement import Map, Measurement
from planish.options import Options, thread_count
from planish.registration.surface import Surface, fit_surface
from planish.registration.texture.camera_contrast import CameraContrast, camera_contrast, view_of_surface
from planish.registration.texture.camera_pattern import FixedPattern
from planish.registration.texture.lowpass import Lowpass, fill_gaps
from planish.registration.texture.shading import projector_shading
from planish.registration.tiles import ground_sample_distance


class PhotometricOptions(Options):
    """Options of the photometric compensation."""

    #: Scale above which a change of brightness counts as shading [mm] (standard deviation of the low-pass).
    shading_mm: float = Field(default=2.5, gt=0)
    #: Normals are averaged over this length for the shading, so that their noise does not become texture [mm].
    normal_mm: float = Field(default=12.0, gt=0)
    #: Local contrast is clipped here: beyond it, highlights and holes rule.
    max_contrast: float = Field(default=0.5, gt=0)
    #: Excess of one camera's brightness over the other's at which its weight has fallen to 1 / e.
    highlight_excess: float = Field(default=0.15, gt=0)


def local_contrast(
    measurement: Measurement,
    options: PhotometricOptions | None = None,
    surface: Surface | None = None,
    fixed: FixedPattern | None = None,
    threads: int | None = None,
) -> tuple[Map, Map]:
    """Return the local contrast and its standard deviation on the organising camera's grid.

    `surface` is the measurement's own fit, computed where it is not given and a projector is known; `fixed` the pattern
    of its sensor, which is removed.

    Returns
    -------
    value : ndarray (H, W) float32
        Relative deviation of the albedo from its surroundings, zero mean; NaN where unknown.
    sigma : ndarray (H, W) float32
        Its standard deviation from camera noise and, with `fixed`, from what stays uncertain of the pattern.
    """
    options = options or PhotometricOptions()
    gsd = ground_sample_distance(measurement)
    if not np.isfinite(gsd):
        nothing = np.full(measurement.shape, np.nan, np.float32)
        return nothing, nothing.copy()
    lowpass = Lowpass.of(options.shading_mm / gsd, thread_count(threads))
    relative = None
    if measurement.rig.projector is not None:
        surface = surface or fit_surface(measurement, threads=threads)
        relative = _relative_shading(measurement, surface, lowpass, options.normal_mm)
    seen = {
        name: camera_contrast(view_of_surface(measurement, name), lowpass, options.max_contrast)
        for name in measurement.texture_views
    }
    if fixed is not None:
        for name, view in seen.items():
            value, variance = fixed.remove(measurement, name, view.value, view.variance, lowpass.threads)
            seen[name] = replace(view, value=value, variance=variance)
    return _merge(measurement, seen, relative, lowpass, options)


def _merge(
    measurement: Measurement,
    seen: dict[str, CameraContrast],
    relative: Map | None,
    lowpass: Lowpass,
    options: PhotometricOptions,
) -> tuple[Map, Map]:
    """Return value and sigma (H, W) of all cameras together on the organising grid."""
    places = {name: None if name == measurement.organised_on else _places(measurement, name) for name in seen}
    levels = [_on_organising_blocks(view.level, places[name], lowpass) for name, view in seen.items()]
    trust = _highlight_trust(levels, options.highlight_excess)
    h, w = lowpass.shape(measurement.shape)
    nowhere = np.empty((0, 0, 2), np.float32)
    views = []
    for (name, view), counted in zip(seen.items(), trust, strict=True):
        place = places[name]
        shading = np.ones((h, w), np.float32)
        if relative is not None:
            # With I = albedo S, lowpass(I) S / lowpass(S) is S times the local mean of the albedo, weighted by S. Room
            # light does not follow S.
            room = fill_gaps(_on_organising_blocks(view.room_share, place, lowpass), 0.0)
            shading = relative + room * (1 - relative)
        views.append((view.value, view.variance, nowhere if place is None else place, shading, counted))
    value, sigma = _core.merge_contrasts(views, measurement.valid.view(np.uint8), lowpass.factor, lowpass.threads)
    return value, sigma


def _places(measurement: Measurement, name: str) -> Map:
    where = measurement.correspondence_px
    assert where is not None, f"texture of camera {name} needs the correspondence"
    return np.ascontiguousarray(where, np.float32)


def _on_organising_blocks(blocks: Map, place: Map | None, lowpass: Lowpass) -> Map:
    """Return blocks (h, w) of a camera at the centres of the organising camera's blocks; NaN where unknown."""
    if place is None:
        return blocks
    centres = (lowpass.centres(place) + np.float32(0.5)) / np.float32(lowpass.factor) - np.float32(0.5)
    u, v = (np.nan_to_num(np.ascontiguousarray(centres[..., i]), nan=-1e4) for i in (0, 1))
    return cv2.remap(blocks, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))


def _relative_shading(measurement: Measurement, surface: Surface, lowpass: Lowpass, normal_mm: float) -> Map | None:
    """Return the projector's light over its own low-pass at blocks (h, w); 1 where it is unknown."""
    shading = projector_shading(measurement, surface, lowpass, normal_mm)
    if shading is None:
        return None
    known = np.isfinite(shading)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = shading / lowpass.ratio(np.where(known, shading, np.float32(0)), known.astype(np.float32))
    return fill_gaps(np.where(known, ratio, np.float32(np.nan)), 1.0)


def _highlight_trust(levels: list[Map], excess: float) -> list[Map]:
    """Weight factor (h, w) per camera: a matt surface is equally bright from everywhere, a highlight is not."""
    if len(levels) < 2:
        return [np.ones_like(level) for level in levels]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = [np.where(level > 0, np.log(level), np.float32(np.nan)) for level in levels]
    difference = logs[0] - logs[1]
    if np.isfinite(difference).any():
        difference = difference - np.nanmedian(difference)
    difference = fill_gaps(difference, 0.0)
    return [np.exp(-((np.maximum(sign * difference, 0) / np.float32(excess)) ** 2)) for sign in (1, -1)]
