"""What the spectrum of a developed texture tells: where it rises above the noise, and which way its grain runs."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.dense.develop import Development

#: Edge of the blocks whose spectra are taken together [px], and the share of a block that must be known.
_BLOCK, _COVERED = 64, 0.75
#: Share of the power that counts as texture at least: where noise is overestimated, nothing must be lost.
_LEAST_SIGNAL = 0.02
#: Scale over which the strength of the filtered texture is made even (standard deviation) [px].
_EVEN_PX = 12.0
#: Angles over 180 degrees and rings of the polar spectrum, and its range [cycles per pixel].
_ANGLES, _RINGS, _RANGE = 360, 24, (0.04, 0.48)
#: Texture whose strongest direction has this many times the mean power has a direction; what foreshortening does to the
#: sharpness of an isotropic texture stays below.
_DIRECTIONAL = 1.5


@dataclass(frozen=True)
class Spectrum:
    """A development filtered for correlation, and the share of texture in its power.

    Parameters
    ----------
    filtered : ndarray (h, w) float32
        The texture, each frequency weighted by sqrt(signal) / (signal + noise), unit variance; 0 outside the mask.
    signal, noise : ndarray (rings, angles) float32
        Power of texture and of noise over frequency and direction (0 to 180 degrees, from the x axis towards y).
    weight : ndarray (rings,)
        Independent values of the spectrum per ring and angle.
    frequency : ndarray (rings,)
        [cycles per mm].
    directional : bool
        Whether the texture has a direction at all.
    """

    filtered: Map
    signal: Map
    noise: Map
    weight: Array
    frequency: Array = field(metadata={"unit": "1/mm"})
    directional: bool


def analyse(development: Development) -> Spectrum:
    """Return the filtered texture and how much of its power is texture."""
    mask = development.mask
    h, w = mask.shape
    size = fft.next_fast_len(h, True), fft.next_fast_len(w, True)
    radius = np.linspace(*_RANGE, _RINGS)
    power, white = _power(development.value, mask), _power(development.noise, mask)
    polar, camera = _polar(power, radius), _polar(white, radius).mean(1)
    level, directional = _noise_level(polar, camera)
    fy, fx = np.meshgrid(np.fft.fftfreq(size[0]), np.fft.rfftfreq(size[1]), indexing="ij")
    everywhere = _at(power, fx, fy)
    noise = np.interp(np.hypot(fy, fx), radius, level).astype(np.float32)
    gain = np.sqrt(np.maximum(everywhere - noise, _LEAST_SIGNAL * everywhere)) / everywhere
    gain[0, 0] = 0
    transform = fft.rfft2(development.value, size)
    filtered = fft.irfft2(transform * gain, size)[:h, :w].astype(np.float32)
    filtered = _evened(np.where(mask, filtered, np.float32(0)), mask)
    signal = np.maximum(polar - level[:, None], 0)
    # Of a ring's area in the plane of frequencies, the half that the other half repeats does not count.
    weight = np.pi * radius * (radius[1] - radius[0]) * mask.sum() / _ANGLES
    return Spectrum(filtered, signal, polar - signal, weight, radius / development.pitch_mm, directional)


def _evened(filtered: Map, mask: NDArray[np.bool_]) -> Map:
    """The same with unit variance everywhere: where the noise is stronger than elsewhere, it must not rule."""
    density, energy = (
        cv2.GaussianBlur(image, (0, 0), _EVEN_PX, borderType=cv2.BORDER_CONSTANT)
        for image in (mask.astype(np.float32), filtered**2)
    )
    return np.where(mask, filtered * np.sqrt(density / np.maximum(energy, np.float32(1e-12))), np.float32(0))


def _noise_level(polar: Map, camera: Array) -> tuple[Array, bool]:
    """Noise (rings,) and whether the texture has a direction.

    The camera's noise is known. What else is there without direction (shape noise in the shading, residual fringes) is
    told from a texture with a direction by the directions in which there is least; from one without it cannot be told.
    """
    above = np.maximum(polar - camera[:, None], 0)
    by_angle = (above / polar.mean(1, keepdims=True)).sum(0)
    directional = bool(by_angle.max() > _DIRECTIONAL * by_angle.mean())
    return (np.maximum(camera, np.percentile(polar, 20, axis=1)) if directional else camera), directional


def _power(image: Map, mask: NDArray[np.bool_]) -> Map:
    """Power spectrum (_BLOCK, _BLOCK / 2 + 1) per pixel, frequencies of y from least to greatest.

    The median over blocks, not the mean (Welch 1967 with the median of Allen et al., Phys. Rev. D 85, 122006, 2012):
    what stands in few of them (rims, seams, dust, scratches) says nothing about the grain.
    """
    view = np.lib.stride_tricks.sliding_window_view
    step = (slice(None, None, _BLOCK // 2),) * 2
    size = (_BLOCK, _BLOCK)
    if min(mask.shape) < _BLOCK:
        pad = [(0, max(0, _BLOCK - n)) for n in mask.shape]
        image, mask = np.pad(image, pad), np.pad(mask, pad)
    known, values = view(mask, size)[step], view(image, size)[step]
    covered = known.mean((2, 3))
    keep = covered >= min(_COVERED, float(covered.max()))
    taper = np.outer(*[np.hanning(_BLOCK + 2)[1:-1]] * 2).astype(np.float32)
    tapered = values[keep] * taper
    energy = ((known[keep] * taper) ** 2).sum((1, 2))
    spectra = np.abs(fft.rfft2(tapered)) ** 2 / np.maximum(energy, np.float32(1e-12))[:, None, None]
    # The median of an exponential distribution is ln 2 of its mean.
    power = np.fft.fftshift(np.median(spectra, axis=0) / np.log(2), axes=0)
    return np.maximum(cv2.GaussianBlur(power.astype(np.float32), (0, 0), 0.8), np.float32(1e-12))


def _at(power: Map, fx: Array, fy: Array) -> Map:
    """Power at frequencies [cycles per pixel]; it is the same both ways."""
    sign = np.where(fx < 0, -1, 1)
    at_x = (fx * sign * _BLOCK).astype(np.float32)
    at_y = (fy * sign * _BLOCK + _BLOCK // 2).astype(np.float32)
    return cv2.remap(power, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _polar(power: Map, radius: Array) -> Map:
    """Power (rings, angles)."""
    angle = np.arange(_ANGLES) * np.pi / _ANGLES
    return _at(power, radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle))


@dataclass(frozen=True)
class Rotations:
    """Rotations (n,) of b's development in a's [rad] that are worth trying, and how many of them make a full turn."""

    angles: Array = field(metadata={"unit": "rad"})
    full_turn: int


#: A rotation is tried if the powers agree as well as this share of the best agreement.
_AGREEMENT = 0.95
#: Phase error of the texture half a step of rotation off, rms over the overlap [rad]; costs a quarter of the height.
_PHASE = 0.8


def plan_rotations(a: Spectrum, b: Spectrum, area_mm2: float) -> Rotations:
    """Return the rotations at which the grain of both runs the same way, for an overlap of `area_mm2`.

    With a direction, these are two opposite neighbourhoods; without one, all rotations.
    """
    level = np.sqrt(((a.signal + a.noise) ** 2).mean(1) * ((b.signal + b.noise) ** 2).mean(1))
    ring = (a.weight / np.maximum(level, 1e-30))[:, None]
    agreement = _over_rotations(ring * a.signal, b.signal)
    share_a, share_b = a.signal / (a.signal + a.noise), b.signal / (b.signal + b.noise)
    weight = np.sqrt(a.weight * b.weight)[:, None]
    information = (weight * share_a * share_b).sum(1)
    frequency = np.sqrt((information * a.frequency**2).sum() / max(information.sum(), 1e-30))
    # Mean square distance from the middle of a disc of that area.
    spread = np.sqrt(area_mm2 / (2 * np.pi))
    step = 2 * _PHASE / max(2 * np.pi * frequency * spread, 1.0)
    full = max(8, int(np.ceil(2 * np.pi / step)))
    angles = 2 * np.pi * np.arange(full) / full
    circle = np.arange(_ANGLES + 1) * np.pi / _ANGLES
    near = np.interp(angles % np.pi, circle, np.append(agreement, agreement[0]))
    keep = near >= _AGREEMENT * max(float(agreement.max()), 0.0)
    return Rotations(angles[keep], full)


def _over_rotations(a: Map | Array, b: Map | Array) -> Array:
    """Sum over rings of a(angle + rotation) * b(angle), per rotation (angles,)."""
    product = np.fft.rfft(a, axis=1) * np.conj(np.fft.rfft(b, axis=1))
    return np.asarray(np.fft.irfft(product.sum(0), _ANGLES))
