"""What is fixed to a sensor, estimated over all captures of a run in pixel coordinates.

A camera's contrast is c = g + t + e: pattern of the sensor (pixel response, dust), texture, noise. Of two captures, g
is what they have in common at the same pixel, unless the part or the background stood still between them. That is told
by the other camera: what one camera saw in one capture and the other, at the corresponding pixel, in another capture
has no sensor pattern in common, only texture that did not move. From the sums of contrasts, of their squares and of
these products over all captures follow the variances of pattern and still texture around each pixel, and with them the
best linear estimate of the pattern (empirical Bayes). No image is kept: the memory does not grow with the captures.
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
    BLOCK_PX,
    CameraPattern,
    FixedPattern,
    block_moments,
    counted_blocks,
    pattern_weights,
)
from planish.registration.texture.lowpass import Lowpass
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
    """Sums over captures of one camera: per pixel (H, W), and per block (h, w) in `moments`."""

    weighted_sum: Map
    weight: Map
    moments: Moments

    @classmethod
    def of(cls, shape: tuple[int, int]) -> _Sums:
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.float32), Moments())

    def add(self, value: Map, variance: Map, weight: Map, threads: int) -> None:
        _core.add_to_pattern(value, weight, BLOCK_PX, self.weighted_sum, self.weight, threads)
        squares, count = block_moments(value, threads)
        noise, _ = _core.block_sums(variance, -np.inf, np.inf, BLOCK_PX, threads)
        self.moments.add(weight, squares, count, noise)


@dataclass
class _Run:
    """All sums of one sensor's captures."""

    cameras: dict[str, _Sums] = field(default_factory=dict)
    still: StillTexture = field(default_factory=StillTexture)


def _estimate(taken: Sequence[Measurement], options: PhotometricOptions, threads: int) -> FixedPattern:
    run = _Run()
    for measurement in taken:
        _add(run, measurement, options, threads)
    first = taken[0].organised_on
    cameras = {}
    for name, sums in run.cameras.items():
        share = run.still.share(sums.moments.shape, own=name == first)
        known = pattern_variances(sums.moments, sums.weighted_sum, sums.weight, share)
        cameras[name] = CameraPattern(sums.weighted_sum, sums.weight, *known)
    return FixedPattern(cameras, frozenset(m.name for m in taken))


def _add(run: _Run, measurement: Measurement, options: PhotometricOptions, threads: int) -> None:
    lowpass = Lowpass.of(options.shading_mm / ground_sample_distance(measurement), threads)
    values: dict[str, Map] = {}
    weights: dict[str, Map] = {}
    for name in measurement.texture_views:
        seen = camera_contrast(measurement.views[name], lowpass, options.max_contrast)
        sums = run.cameras.setdefault(name, _Sums.of(seen.value.shape))
        values[name] = seen.value
        weights[name] = pattern_weights(seen.value, threads) * counted_blocks(measurement, name)
        sums.add(seen.value, seen.variance, weights[name], threads)
    run.still.add(measurement, values, weights[measurement.organised_on])
