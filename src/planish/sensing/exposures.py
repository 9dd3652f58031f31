"""Bracketed exposures: one capture per exposure, and what they saw merged pixel by pixel.

Positions do not depend on the exposure: those that agree are averaged by their variances, and a pixel that is
saturated or dark in one exposure is taken from another. Grey levels do: they are brought onto the scale of the longest
exposure, so that the texture is that of one image with a larger range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.measurement import Map, NoiseModel, View, rejection_bit
from planish.sensing.capture.manifest import Capture
from planish.sensing.decode import PhaseMap
from planish.sensing.observe import Observation

Mask = NDArray[np.bool_]

#: Positions of two exposures that differ by more standard deviations do not agree: the better one stands alone.
AGREEMENT_SIGMAS = 5.0
#: A pixel is unsaturated where its brightest step stays below saturation by so many standard deviations.
SATURATION_SIGMAS = 4.0
#: Pixels that two exposures must share for their scales to be compared; amplitudes below this share do not count.
MIN_SHARED, MIN_MODULATION = 400, 0.1
#: Exposures have something in common where their differences scatter less by so many standard deviations.
CHANCE_SIGMAS = 3.0
#: Bins of grey level to which the noise of the merged texture is fitted.
LEVELS = 32
#: Every so many rows and columns tell the scales of the exposures and the noise of the merged texture.
STRIDE = 2


def split_exposures(capture: Capture) -> tuple[tuple[float, Capture], ...]:
    """Return (exposure [ms], capture) of each exposure, from the longest to the shortest; the capture itself if one.

    The exposure of a capture that names none is 1.
    """
    manifest = capture.manifest
    exposures = {entry.exposure_ms for entry in manifest.sequence}
    if len(exposures) == 1 or None in exposures:
        return ((next(iter(exposures)) or 1.0, capture),)
    parts = []
    for exposure in sorted((e for e in exposures if e is not None), reverse=True):
        kept = [k for k, entry in enumerate(manifest.sequence) if entry.exposure_ms == exposure]
        names = {"A": manifest.images.A, "B": manifest.images.B}
        images = {name: None if files is None else [files[k] for k in kept] for name, files in names.items()}
        part = manifest.model_copy(
            update={
                "images": manifest.images.model_copy(update=images),
                "sequence": [manifest.sequence[k] for k in kept],
            }
        )
        parts.append((exposure, replace(capture, manifest=part)))
    return tuple(parts)


def merge_exposures(observations: Sequence[Observation], exposures_ms: Sequence[float]) -> Observation:
    """Return what one camera saw in all exposures together.

    Parameters
    ----------
    observations : sequence of Observation
        Of one camera, from the longest exposure to the shortest.
    exposures_ms : sequence of float
        Their exposure times [ms].

    Returns
    -------
    Observation
        `rejected` only where all exposures are: with the reason of the one that came furthest. Texture on the scale of
        the longest exposure; its `saturation` is that of the shortest on this scale.

    Raises
    ------
    InputError
        Where there are no positions to merge: statistical patterns.

    Notes
    -----
    Independent noise: x = sum(x_i / s_i^2) / sum(1 / s_i^2), 1 / s^2 = sum(1 / s_i^2). The merged NoiseModel is a line
    fitted to the variance of the merged texture over its grey levels. That is an approximation: the variance jumps
    where the longest exposure saturates and only noisier, scaled-up exposures are left.
    """
    if len(observations) == 1:
        return observations[0]
    if not all(observation.phases for observation in observations):
        raise InputError(
            "exposures", "several, of patterns that give no position", "one, or fringes or Gray code at each"
        )
    phases = {axis: merge_positions([o.phases[axis] for o in observations]) for axis in observations[0].phases}
    findings = tuple(
        replace(finding, quantity=f"{finding.quantity} at {exposure:g} ms")
        for observation, exposure in zip(observations, exposures_ms, strict=True)
        for finding in observation.findings
    )
    view = merge_views([o.view for o in observations], [_saturated(o) for o in observations], exposures_ms)
    return replace(observations[0], phases=phases, view=view, findings=findings)


def merge_positions(maps: Sequence[PhaseMap]) -> PhaseMap:
    """Return the positions (H, W) of several exposures averaged by their variances where they agree.

    Notes
    -----
    What is common to all exposures (edges of a Gray code that lean on each other) no mean makes smaller, and no
    difference shows: where differences scatter less than the sigmas say, a share r of the variances is independent,
    and s^2 = r / sum(1 / s_i^2) + (1 - r) (sum(1 / s_i) / sum(1 / s_i^2))^2.
    """
    valid = [(m.rejected == 0) & np.isfinite(m.position_px) for m in maps]
    sigma = np.stack([np.where(ok, m.sigma_px, np.float32(np.inf)) for m, ok in zip(maps, valid, strict=True)])
    best = np.argmin(sigma, axis=0)[None]
    start = np.take_along_axis(np.stack([m.position_px for m in maps]), best, 0)[0]
    least = np.take_along_axis(sigma, best, 0)[0]
    weight, shift, alike = np.zeros_like(start), np.zeros_like(start), np.zeros_like(start)
    scatter: list[Map] = []
    for k, (m, ok) in enumerate(zip(maps, valid, strict=True)):
        with np.errstate(invalid="ignore"):
            difference = m.position_px - start
            other = (ok & (best[0] != k))[::STRIDE, ::STRIDE]
            scatter.append((difference / np.hypot(m.sigma_px, least))[::STRIDE, ::STRIDE][other])
            agrees = ok & (np.abs(difference) <= AGREEMENT_SIGMAS * np.hypot(m.sigma_px, least))
        own = np.where(agrees, 1 / np.square(np.where(agrees, m.sigma_px, 1)), np.float32(0))
        weight += own
        alike += np.sqrt(own)
        shift += np.where(agrees, own * difference, np.float32(0))
    found = weight > 0
    total = np.where(found, weight, np.float32(1))
    share = np.float32(_independent_share(np.concatenate(scatter)))
    variance = share / total + (1 - share) * np.square(alike / total)
    nothing = np.float32(np.nan)
    return replace(
        maps[0],
        position_px=np.where(found, start + shift / total, nothing),
        sigma_px=np.where(found, np.sqrt(variance), nothing),
        rejected=np.where(found, np.uint16(0), _furthest([m.rejected for m in maps])),
    )


def _independent_share(scatter: Map) -> float:
    """Return the share of the variance that differs between exposures, from their normalised differences (n,)."""
    if scatter.size < MIN_SHARED:
        return 1.0
    share = float(1.4826 * np.median(np.abs(scatter))) ** 2
    # The squared median of n absolute deviations has the relative standard deviation 2.33 / sqrt(n).
    return share if share < 1 - CHANCE_SIGMAS * 2.33 / scatter.size**0.5 else 1.0


def _furthest(rejected: Sequence[NDArray[np.uint16]]) -> NDArray[np.uint16]:
    """Return the reasons (H, W) of the exposure that came furthest: whose first reason stands last in REJECTIONS."""
    out = rejected[0].copy()
    first = out & (~out + np.uint16(1))
    for other in rejected[1:]:
        lowest = other & (~other + np.uint16(1))
        further = lowest > first
        out[further], first[further] = other[further], lowest[further]
    return out


def _saturated(observation: Observation) -> Mask:
    """Pixels (H, W) with a step at saturation, or too near to it for its noise."""
    view = observation.view
    limit = view.saturation - SATURATION_SIGMAS * (view.noise.offset + view.noise.slope * view.saturation) ** 0.5
    brightest = [m for m in (view.mean, view.white) if m is not None]
    if view.mean is not None and view.modulation is not None:
        brightest.append(view.mean + view.modulation)
    if view.mean is not None and view.white is not None:
        # Mean of the fringes = half-way between white and black; the white image has the black one subtracted.
        brightest.append(view.mean + 0.5 * view.white)
    bit = rejection_bit("saturated")
    out = np.logical_or.reduce([(phase.rejected & bit) != 0 for phase in observation.phases.values()])
    for level in brightest:
        out |= ~(level < limit)
    return np.asarray(out)


@dataclass(frozen=True)
class _Scale:
    """Grey level on the scale of the longest exposure = gain * level + offset."""

    gain: float
    mean_offset: float
    white_offset: float


def merge_views(views: Sequence[View], saturated: Sequence[Mask], exposures_ms: Sequence[float]) -> View:
    """Return the texture of several exposures on the scale of the longest, averaged by the noise of the means.

    Parameters
    ----------
    views : sequence of View
        From the longest exposure to the shortest.
    saturated : sequence of ndarray (H, W) bool
        Pixels that are not to be used; where all are saturated, the shortest exposure is taken.
    exposures_ms : sequence of float
        Exposure times [ms].
    """
    scales = [_Scale(1.0, 0.0, 0.0)]
    for k in range(1, len(views)):
        shared = (~saturated[k - 1] & ~saturated[k])[::STRIDE, ::STRIDE]
        scales.append(_onto(scales[-1], views[k - 1], views[k], shared, exposures_ms[k - 1] / exposures_ms[k]))
    weights: list[Map] = []
    for k, (view, scale) in enumerate(zip(views, scales, strict=True)):
        level = view.mean if view.mean is not None else view.white
        assert level is not None
        own = np.float32(max(view.mean_images, 1) / scale.gain**2) / view.noise.variance(level)
        weights.append(np.where(saturated[k], np.float32(0), own))
    nowhere = np.logical_and.reduce(saturated)
    weights[-1][nowhere] = 1
    total = np.sum(weights, axis=0, dtype=np.float32)
    shares = [w / total for w in weights]
    mean = _combine([v.mean for v in views], shares, [(s.gain, s.mean_offset) for s in scales])
    white = _combine([v.white for v in views], shares, [(s.gain, s.white_offset) for s in scales])
    modulation = _combine([v.modulation for v in views], shares, [(s.gain, 0.0) for s in scales])
    level = mean if mean is not None else white
    assert level is not None
    known = ~nowhere[::STRIDE, ::STRIDE]
    precision = np.sum([w[::STRIDE, ::STRIDE][known] for w in weights], axis=0)
    noise = _fit_noise(level[::STRIDE, ::STRIDE][known], views[0].mean_images / precision, views[0].noise)
    last = scales[-1]
    return View(
        white, mean, modulation, views[0].mean_images, noise, views[-1].saturation * last.gain + last.mean_offset
    )


def _onto(longer_scale: _Scale, longer: View, shorter: View, shared: Mask, nominal: float) -> _Scale:
    """Compose the scale of an exposure from that of the next longer one and what both saw unsaturated.

    The times that cameras are set to are not always those they keep: the amplitudes tell their ratio. The offset is
    the sensor's black level, which does not grow with time.
    """
    gain = nominal
    if longer.modulation is not None and shorter.modulation is not None:
        a, b = (m[::STRIDE, ::STRIDE] for m in (longer.modulation, shorter.modulation))
        bright = shared & (a > MIN_MODULATION * longer.saturation)
        if np.count_nonzero(bright) >= MIN_SHARED:
            gain = float(np.median(a[bright] / b[bright]))
    offsets = []
    for long, short in ((longer.mean, shorter.mean), (longer.white, shorter.white)):
        if long is None or short is None or np.count_nonzero(shared) < MIN_SHARED:
            offsets.append(0.0)
        else:
            offsets.append(float(np.median((long[::STRIDE, ::STRIDE] - gain * short[::STRIDE, ::STRIDE])[shared])))
    return _Scale(
        longer_scale.gain * gain,
        longer_scale.gain * offsets[0] + longer_scale.mean_offset,
        longer_scale.gain * offsets[1] + longer_scale.white_offset,
    )


def _combine(maps: Sequence[Map | None], shares: Sequence[Map], scales: Sequence[tuple[float, float]]) -> Map | None:
    total: Map = np.zeros_like(shares[0])
    for values, w, (gain, offset) in zip(maps, shares, scales, strict=True):
        if values is None:
            return None
        total += np.where(w > 0, w * (np.float32(gain) * values + np.float32(offset)), np.float32(0))
    return total


def _fit_noise(level: Map, variance: Map, longest: NoiseModel) -> NoiseModel:
    """Return offset and slope of the variances (n,) of pixels with these levels (n,), fitted to relative errors."""
    if level.size < MIN_SHARED:
        return longest
    low, high = float(level.min()), float(level.max()) + 1e-3
    members = ((level - low) * (LEVELS / (high - low))).astype(np.int64).clip(0, LEVELS - 1)
    count = np.bincount(members, minlength=LEVELS)
    full = count > 0
    x, y = (np.bincount(members, values, LEVELS)[full] / count[full] for values in (level, variance))
    weight = np.sqrt(count[full]) / y
    A = np.column_stack([np.ones_like(x), x]) * weight[:, None]
    offset, slope = np.linalg.lstsq(A, y * weight, rcond=None)[0] if len(x) > 1 else (float(y[0]), 0.0)
    if slope < 0 or offset < 0:
        scaled = A[:, 1] if offset < 0 else A[:, 0]
        only = float(scaled @ (y * weight) / (scaled @ scaled))
        return NoiseModel(0.0, only) if offset < 0 else NoiseModel(only, 0.0)
    return NoiseModel(float(offset), float(slope))
