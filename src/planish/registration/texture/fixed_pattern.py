"""What is fixed to a sensor, estimated over all captures of a run in pixel coordinates.

A camera's contrast is c = g + t + e: pattern of the sensor (pixel response, dust), texture, noise. Of two captures, g
is what they have in common at the same pixel, unless the part or the background stood still between them. That is told
by the other camera: what one camera saw in one capture and the other, at the corresponding pixel, in another capture
has no sensor pattern in common, only texture that did not move. From the sums of contrasts, of their squares and of
these products over all captures follow the variances of pattern and still texture around each pixel, and with them the
best linear estimate of the pattern (empirical Bayes), in two bands: texture hides the coarse one more than the fine
one. No image is kept: the memory does not grow with the captures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from planish import _core
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.texture.camera_contrast import camera_contrast
from planish.registration.texture.camera_pattern import (
    BAND_CELLS_PX,
    BAND_NOISE,
    BLOCK_PX,
    BandPattern,
    CameraPattern,
    FixedPattern,
    block_moments,
    counted_blocks,
    pattern_weights,
    split_bands,
)
from planish.registration.texture.lowpass import EVERYWHERE, Lowpass
from planish.registration.texture.pattern_variances import Moments, StillTexture, pattern_variances
from planish.registration.texture.photometric import PhotometricOptions
from planish.registration.tiles import ground_sample_distance
from planish.rig import Camera

#: Numbers of a camera's kernel parameters that describe its image: focal lengths, centre, skew, distortion.
_INTRINSICS = 17


def estimate_fixed_patterns(
    measurements: Sequence[Measurement], options: PhotometricOptions | None = None, threads: int | None = None
) -> dict[str, FixedPattern]:
    """Return the sensor's pattern by the name of the measurement, for all whose sensor took more than one.

    Measurements are of one sensor where their cameras have the same calibration. Their order does not matter.
    """
    options, count = options or PhotometricOptions(), thread_count(threads)
    sensors: dict[tuple[object, ...], list[Measurement]] = {}
    for measurement in sorted(measurements, key=lambda m: m.name):
        if np.isfinite(ground_sample_distance(measurement)):
            sensors.setdefault(_sensor(measurement), []).append(measurement)
    found: dict[str, FixedPattern] = {}
    for taken in sensors.values():
        if len(taken) > 1:
            pattern = _estimate(taken, options, count)
            found |= {m.name: pattern for m in taken}
    return found


def _sensor(measurement: Measurement) -> tuple[object, ...]:
    names = measurement.texture_views
    return (measurement.organised_on, *((n, _image_geometry(measurement.rig.cameras[n])) for n in names))


def _image_geometry(camera: Camera) -> tuple[object, ...]:
    return (camera.size_px, np.asarray(camera.kernel_parameters[:_INTRINSICS]).tobytes())


@dataclass
class _Sums:
    """Sums over captures of one band of a camera: per pixel (H, W), and per block (h, w) in `moments`."""

    weighted_sum: Map
    weight: Map
    moments: Moments

    @classmethod
    def of(cls, shape: tuple[int, int]) -> _Sums:
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.float32), Moments())

    def add(self, value: Map, noise: Map, counted: Map, threads: int) -> None:
        weight = pattern_weights(value, threads) * counted
        _core.add_to_pattern(value, weight, BLOCK_PX, self.weighted_sum, self.weight, threads)
        self.moments.add(weight, *block_moments(value, threads), noise)


@dataclass
class _Run:
    """All sums of one sensor's captures: per camera those of the fine and the coarse band."""

    cameras: dict[str, tuple[_Sums, _Sums]] = field(default_factory=dict)
    still: StillTexture = field(default_factory=StillTexture)


def _estimate(taken: Sequence[Measurement], options: PhotometricOptions, threads: int) -> FixedPattern:
    run = _Run()
    for measurement in taken:
        _add(run, measurement, options, threads)
    first = taken[0].organised_on
    cameras = {}
    for name, bands in run.cameras.items():
        share = run.still.share(bands[0].moments.shape, own=name == first)
        fine, coarse = (
            BandPattern(
                sums.weighted_sum,
                sums.weight,
                *pattern_variances(sums.moments, sums.weighted_sum, sums.weight, share, cells),
            )
            for sums, cells in zip(bands, BAND_CELLS_PX, strict=True)
        )
        cameras[name] = CameraPattern((fine, coarse))
    return FixedPattern(cameras, frozenset(m.name for m in taken))


def _add(run: _Run, measurement: Measurement, options: PhotometricOptions, threads: int) -> None:
    lowpass = Lowpass.of(options.shading_mm / ground_sample_distance(measurement), threads)
    values: dict[str, Map] = {}
    for name in measurement.texture_views:
        seen = camera_contrast(measurement, name, lowpass, options.max_contrast)
        values[name], shape = seen.value, (seen.value.shape[0], seen.value.shape[1])
        bands = run.cameras.setdefault(name, (_Sums.of(shape), _Sums.of(shape)))
        counted = counted_blocks(measurement, name)
        noise, _ = _core.block_sums(seen.variance, -np.inf, np.inf, EVERYWHERE, BLOCK_PX, threads)
        for sums, part, share in zip(bands, split_bands(seen.value), BAND_NOISE, strict=True):
            sums.add(part, noise * np.float32(share), counted, threads)
        if name == measurement.organised_on:
            weight = pattern_weights(seen.value, threads) * counted
    run.still.add(measurement, values, weight)
