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
from functools import partial

import cv2
import numpy as np
from pydantic import Field

from planish import _core
from planish.measurement import Map, Measurement
from planish.options import Options, side_by_side, thread_count
from planish.registration.surface import Surface, fit_surface
from planish.registration.texture.camera_contrast import CameraContrast, camera_contrast
from planish.registration.texture.camera_grid import correspondence, from_camera_blocks
from planish.registration.texture.camera_pattern import FixedPattern
from planish.registration.texture.lowpass import Lowpass, fill_gaps
from planish.registration.texture.shading import projector_shading
from planish.registration.tiles import ground_sample_distance

#: The long way over which normals are averaged, in multiples of the short one.
_SMOOTHER = 4.0
#: The surface is held to be smooth at most places: the median power is that of noise, whose local power varies.
_NOISE_MARGIN = 3.0


class PhotometricOptions(Options):
    """Options of the photometric compensation."""

    #: Scale above which a change of brightness counts as shading [mm] (standard deviation of the low-pass).
    shading_mm: float = Field(default=2.5, gt=0)
    #: Normals are averaged over this length for the shading where the surface bends, over more elsewhere [mm].
    normal_mm: float = Field(default=3.0, gt=0)
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
    count, names = thread_count(threads), measurement.texture_views
    whole = Lowpass.of(options.shading_mm / gsd, count)
    # Cameras and light side by side: much of each is too small to be shared out by rows.
    lowpass = replace(whole, threads=max(1, count // max(1, len(names))))

    def contrast(name: str) -> CameraContrast:
        view = camera_contrast(measurement, name, lowpass, options.max_contrast)
        if fixed is None:
            return view
        value, variance = fixed.remove(measurement, name, view.value, view.variance, lowpass.threads)
        return replace(view, value=value, variance=variance)

    def shading() -> Map | None:
        if measurement.rig.projector is None:
            return None
        own = surface or fit_surface(measurement, threads=lowpass.threads)
        return _relative_shading(measurement, own, lowpass, options)

    relative, *views = side_by_side([shading, *(partial(contrast, name) for name in names)], count)
    seen = dict(zip(names, views, strict=True))
    levels = _on_own_blocks(measurement, seen, lowpass)
    trust = _highlight_trust([level for level, _ in levels], options.highlight_excess)
    # One after the other, by rows: the camera that is read between its pixels takes several times as long.
    parts = [
        (*_image(measurement, name, view, room, relative, whole), counted)
        for (name, view), (_, room), counted in zip(seen.items(), levels, trust, strict=True)
    ]
    return _core.merge_contrasts(parts, measurement.valid.view(np.uint8), whole.factor, count)


def _on_own_blocks(
    measurement: Measurement, seen: dict[str, CameraContrast], lowpass: Lowpass
) -> list[tuple[Map, Map]]:
    """Return level and share of room light (h, w) of each camera on the organising grid."""
    maps = [from_camera_blocks(measurement, name, (v.level, v.room_share), lowpass) for name, v in seen.items()]
    return [(level, room) for level, room in maps]


def _image(
    measurement: Measurement, name: str, view: CameraContrast, room: Map, relative: Map | None, lowpass: Lowpass
) -> tuple[Map, Map, Map]:
    """Return a camera's image, its variance (H, W) and what even albedo would show (h, w), on the organising grid."""
    own = name == measurement.organised_on
    place = np.empty((0, 0, 2), np.float32) if own else correspondence(measurement, name)
    level = fill_gaps(view.level, 0.0)
    # The low-pass is taken twice, and over the same pixels for all cameras and the light.
    gain, seen = lowpass.noise_left(2) / lowpass.noise_left(), measurement.valid.view(np.uint8)
    image, variance, total, count = _core.compensated_image(
        view.value, view.variance, level, lowpass.factor, place, seen, gain, lowpass.threads
    )
    expected = lowpass.ratio(total, count)
    if relative is not None:
        # With I = albedo S, lowpass(I) S / lowpass(S) is S times the local mean of the albedo, weighted by S. Room
        # light does not follow S.
        room = fill_gaps(room, 0.0)
        expected = expected * (relative + room * (1 - relative))
    expected = expected * _left_over(total, count, expected, lowpass)
    return image, variance, expected


def _left_over(total: Map, count: Map, expected: Map, lowpass: Lowpass) -> Map:
    """Return what still changes slowly in an image, given by its sums over blocks (h, w), against what is expected.

    Light that grazes the surface is predicted badly, since errors of the normals count most there and the points of a
    bent surface's rim are the worst: a second pass of the low-pass takes what the first one left (twicing: Tukey 1977).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(expected > 0, total / expected, np.float32(0))
    return lowpass.ratio(relative, np.where(expected > 0, count, np.float32(0)))


def _relative_shading(measurement: Measurement, surface: Surface, lowpass: Lowpass, options: PhotometricOptions) -> Map:
    """Return the projector's light over its low-pass at blocks (h, w), 1 where it is unknown.

    Noise of the normals would become texture: what they tell when averaged over a short way, beyond what they tell
    over a long one, counts as far as its power around a place exceeds that of noise (Wiener filter).
    """
    fine, smooth = (
        _over_lowpass(shading, lowpass)
        for shading in projector_shading(
            measurement, surface, lowpass, (options.normal_mm, _SMOOTHER * options.normal_mm)
        )
    )
    detail, known = np.nan_to_num(fine - smooth), np.isfinite(fine).astype(np.float32)
    deviation = max(1.0, _SMOOTHER * options.normal_mm / (measurement.sample_distance_mm * lowpass.factor) / 2)
    power, share = (cv2.GaussianBlur(m, (0, 0), deviation) for m in (detail**2 * known, known))
    with np.errstate(divide="ignore", invalid="ignore"):
        power = power / share
        noise = np.float32(np.median(power[known > 0])) if known.any() else np.float32(0)
        kept = np.nan_to_num(np.clip(1 - _NOISE_MARGIN * noise / power, 0, 1))
    return fill_gaps(np.where(known > 0, smooth + kept * detail, np.float32(np.nan)), 1.0)


def _over_lowpass(shading: Map, lowpass: Lowpass) -> Map:
    known = np.isfinite(shading)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = shading / lowpass.ratio(np.where(known, shading, np.float32(0)), known.astype(np.float32))
    return np.where(known, ratio, np.float32(np.nan)).astype(np.float32)


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
