"""The contrast that one camera saw, on its own pixel grid: all kinds of its images, combined by their noise.

Mean of the fringe images, white and modulation hold the same texture, the same pattern of the sensor and different
noise. Mean and modulation are computed from the same images: their noise is correlated where it grows with the light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.measurement import Map, Measurement, NoiseModel, View
from planish.registration.texture.camera_grid import surface_seen
from planish.registration.texture.lowpass import Lowpass

#: Grey values below so many standard deviations of their noise hold no texture.
_MIN_SIGMAS = 3.0
#: Pixels at which kinds of images are compared, about, and the fewest that say anything.
_COMPARED, _MIN_COMPARED = 20_000, 400
#: Standard deviation over the median absolute deviation of normal errors.
_PER_MAD = 1.4826
#: White images below this share of saturation certainly are not.
_UNSATURATED = 0.9
#: Every so many pixels tell the dark image.
_SPARSE = 8
#: The covariance of two kinds is held below the smaller variance, so that no weight is negative.
_MAX_COVARIANCE = 0.9
#: What the kernel takes for noise that is not correlated.
_NOTHING = np.empty((0, 0), np.float32)

#: Pixels (H, W) that show the surface.
Seen = NDArray[np.bool_]


@dataclass(frozen=True)
class CameraContrast:
    """Contrast of one camera on its own grid.

    Parameters
    ----------
    value : ndarray (H, W) float32
        Relative deviation of the grey value from its low-pass; NaN where no image is usable.
    variance : ndarray (H, W) float32
        Variance of its noise.
    level : ndarray (h, w) float32
        Low-pass of the brightness at blocks; NaN where unknown.
    room_share : ndarray (h, w) float32
        Share of the light that is not the projector's, as the combination holds it.
    """

    value: Map
    variance: Map
    level: Map
    room_share: Map


@dataclass(frozen=True)
class _Kind:
    """One kind of image: grey values with their usable range, low-pass (h, w), variance (h, w) of the contrast."""

    image: Map
    low: float
    high: float
    level: Map
    variance: Map


def camera_contrast(measurement: Measurement, name: str, lowpass: Lowpass, limit: float) -> CameraContrast:
    """Return the contrast of a camera where it sees the measured surface, clipped at +-`limit`.

    What lies beside it, lit or not, does not enter the low-pass.
    """
    view, seen = measurement.views[name], surface_seen(measurement, name, lowpass)
    kinds = _kinds(view, seen, lowpass)
    covariance = _covariance(view, kinds)
    kinds = _with_unexplained(kinds, covariance, seen)
    value, variance, first_weight = _core.camera_contrast(
        [np.ascontiguousarray(k.image, np.float32) for k in kinds.values()],
        [(k.low, k.high) for k in kinds.values()],
        np.ascontiguousarray(seen).view(np.uint8),
        [k.level for k in kinds.values()],
        [k.variance for k in kinds.values()],
        # Mean comes first and modulation last.
        _NOTHING if covariance is None else covariance,
        lowpass.noise_left(),
        lowpass.factor,
        limit,
        lowpass.threads,
    )
    return CameraContrast(value, variance, next(iter(kinds.values())).level, _room_share(kinds, first_weight))


def _kinds(view: View, seen: Seen, lowpass: Lowpass) -> dict[str, _Kind]:
    """Return the images that hold texture, mean first, each with the variance that the camera's noise gives it."""
    dark, images = _dark_limit(view.noise), float(view.mean_images or 1)
    kinds: dict[str, _Kind] = {}
    if view.mean is not None:
        kinds["mean"] = _kind(view.mean, (dark, np.inf), seen, view.noise, 1 / images, lowpass)
    if view.white is not None:
        limits = (dark, _white_limit(view, seen))
        kinds["white"] = _kind(view.white, limits, seen, view.noise, 1.0, lowpass)
    if view.mean is not None and view.modulation is not None:
        # Amplitude of N phase steps: 2 / N of the variance of one of them, at the mean light.
        light = kinds["mean"].level
        found = _kind(view.modulation, (dark, np.inf), seen, view.noise, 2 / images, lowpass, light)
        loss = _saturation_loss(light, found.level, view.saturation)
        kinds["modulation"] = replace(found, variance=found.variance * loss)
        kinds["mean"] = replace(kinds["mean"], variance=kinds["mean"].variance * loss)
    return kinds


def _kind(
    image: Map,
    limits: tuple[float, float],
    seen: Seen,
    noise: NoiseModel,
    share: float,
    lowpass: Lowpass,
    light: Map | None = None,
) -> _Kind:
    level = lowpass(image, *limits, seen)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = noise.variance(level if light is None else light) * np.float32(share) / level**2
    return _Kind(image, *limits, level, np.where(level > 0, variance, np.float32(np.nan)).astype(np.float32))


def _white_limit(view: View, seen: Seen) -> float:
    """Return the grey value from which the white image may be saturated: a dark image was subtracted from it.

    The dark image is what the mean of the fringe images exceeds half of white by.
    """
    if view.mean is None or view.white is None:
        return view.saturation
    white, mean, shown = (m[_SPARSE // 2 :: _SPARSE, _SPARSE // 2 :: _SPARSE] for m in (view.white, view.mean, seen))
    dark = np.maximum(mean - white / 2, 0)
    dark = dark[shown & np.isfinite(dark) & (white < _UNSATURATED * view.saturation)]
    if dark.size == 0:
        return view.saturation
    # At most places; the dark image's own noise comes on top.
    least = float(np.percentile(dark, 95))
    return view.saturation - least - _MIN_SIGMAS * float(np.sqrt(view.noise.offset + view.noise.slope * least))


def _saturation_loss(mean: Map, amplitude: Map, saturation: float) -> Map:
    """Return the factor (h, w) on the variance of mean and amplitude where saturated steps are left out.

    Of four steps one comes within 45 degrees of the crest. Where it is left out, the mean of the two beside it, with
    twice the variance, tells the mean of all; more steps lose less.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        crest = np.arccos(np.clip((saturation - mean) / amplitude, -1, 1))
    return np.asarray(1 + np.nan_to_num(np.clip(crest / (np.pi / 4), 0, 1)), np.float32)


def _dark_limit(noise: NoiseModel) -> float:
    """Return the grey value that is `_MIN_SIGMAS` of its own standard deviations."""
    half = 0.5 * _MIN_SIGMAS**2 * noise.slope
    return float(half + np.sqrt(half**2 + _MIN_SIGMAS**2 * max(noise.offset, 0.0)))


def _covariance(view: View, kinds: dict[str, _Kind]) -> Map | None:
    """Covariance (h, w) of the noise of mean and modulation, or None.

    A = sum I_k / N, B = 2 / N sum I_k cos(phi - 2 pi k / N), var I_k = offset + slope I_k: cov(A, B) = slope B / N.
    """
    if "modulation" not in kinds:
        return None
    mean, modulation = kinds["mean"], kinds["modulation"]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Both contrasts: over A and over B.
        covariance = np.float32(view.noise.slope / view.mean_images) / mean.level
    return np.minimum(covariance, _MAX_COVARIANCE * np.fmin(mean.variance, modulation.variance)).astype(np.float32)


def _with_unexplained(kinds: dict[str, _Kind], covariance: Map | None, seen: Seen) -> dict[str, _Kind]:
    """Raise the variance of every further kind by what its difference to the first shows beyond the stated noise.

    Texture and sensor pattern cancel in the difference. What is left over is what the noise model does not know: a
    subtracted dark image, residual fringes of a gamma, modulation that was not computed from phase steps.
    """
    names = list(kinds)
    first, out = kinds[names[0]], dict(kinds)
    for name in names[1:]:
        other = kinds[name]
        common = covariance if name == "modulation" and covariance is not None else np.float32(0)
        expected = first.variance + other.variance - 2 * common
        excess = _excess(first, other, expected, seen)
        out[name] = _Kind(other.image, other.low, other.high, other.level, other.variance + excess * expected)
    return out


def _excess(first: _Kind, other: _Kind, expected: Map, seen: Seen) -> np.float32:
    """Return by what share the variance of the difference of two kinds exceeds the expected (h, w); 0 where unknown."""
    height, width = first.image.shape
    step = max(1, round(np.sqrt(height * width / _COMPARED)))
    count, deviation = _core.contrast_scatter(
        (np.ascontiguousarray(first.image, np.float32), np.ascontiguousarray(other.image, np.float32)),
        ((first.low, first.high), (other.low, other.high)),
        np.ascontiguousarray(seen).view(np.uint8),
        (first.level, other.level),
        expected,
        -(-height // expected.shape[0]),
        step,
    )
    return np.float32(max(0.0, (_PER_MAD * deviation) ** 2 - 1.0) if count >= _MIN_COMPARED else 0.0)


def _room_share(kinds: dict[str, _Kind], weight_of_mean: Map) -> Map:
    """Share (h, w) of light that is not the projector's: mean = room light + half of white (less dark)."""
    if "mean" not in kinds or "white" not in kinds:
        return np.zeros_like(weight_of_mean)
    mean, white = kinds["mean"].level, kinds["white"].level
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip((mean - white / 2) / mean, 0, 1) * weight_of_mean
    return np.nan_to_num(share).astype(np.float32)
