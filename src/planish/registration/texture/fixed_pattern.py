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

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from planish import _core
from planish.errors import InputError
from planish.measurement import Map, Measurement
from planish.options import side_by_side, thread_count
from planish.registration.texture.camera_contrast import camera_contrast
from planish.registration.texture.camera_pattern import (
    BAND_CELLS_PX,
    BAND_NOISE,
    BLOCK_PX,
    Band,
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


#: Captures whose sums are made in one go, and then added to those of the next ones. The grouping decides about the
#: last bits of the sums: fixed, so that it does not matter who makes them and when.
CAPTURES_PER_SUM = 16


def estimate_fixed_patterns(
    measurements: Sequence[Measurement], options: PhotometricOptions | None = None, threads: int | None = None
) -> dict[str, FixedPattern]:
    """Return the sensor's pattern by the name of the measurement, for all whose sensor took more than one.

    Measurements are of one sensor where their cameras have the same calibration. Their order does not matter.
    """
    sensors: dict[str, list[Measurement]] = {}
    for measurement in sorted(measurements, key=lambda m: m.name):
        sensor = sensor_key(measurement)
        if sensor is not None:
            sensors.setdefault(sensor, []).append(measurement)
    found: dict[str, FixedPattern] = {}
    for taken in sensors.values():
        if len(taken) > 1:
            groups = (taken[i : i + CAPTURES_PER_SUM] for i in range(0, len(taken), CAPTURES_PER_SUM))
            sums = add_sums(sum_captures(group, options, threads) for group in groups)
            names = [m.name for m in taken]
            found |= dict.fromkeys(names, sums.pattern(names, thread_count(threads)))
    return found


def sensor_key(measurement: Measurement) -> str | None:
    """Return the same text for all measurements by one sensor; None where nothing is known of its pattern."""
    if not np.isfinite(ground_sample_distance(measurement)):
        return None
    names = measurement.texture_views
    text = repr((measurement.organised_on, *((n, _image_geometry(measurement.rig.cameras[n])) for n in names)))
    return hashlib.sha256(text.encode()).hexdigest()


def _image_geometry(camera: Camera) -> tuple[object, ...]:
    return (camera.size_px, np.asarray(camera.kernel_parameters[:_INTRINSICS]).tobytes())


@dataclass
class BandSums:
    """Sums over captures of one band of a camera: per pixel (H, W), and per block (h, w) in `moments`."""

    weighted_sum: Map
    weight: Map
    moments: Moments

    @classmethod
    def of(cls, shape: tuple[int, int]) -> BandSums:
        """Return the sums over no captures of (H, W) pixels."""
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.float32), Moments())

    def add(self, band: Band, noise: Map, counted: Map, threads: int) -> None:
        """Add a capture's band, its noise variances and whether it counts per block (h, w)."""
        weight = pattern_weights(band.squares, band.count) * counted
        _core.add_to_pattern(band.value, weight, BLOCK_PX, self.weighted_sum, self.weight, threads)
        self.moments.add(weight, band.squares, band.count, noise)

    def merge(self, other: BandSums) -> None:
        """Add the sums over other captures."""
        self.weighted_sum = self.weighted_sum + other.weighted_sum
        self.weight = self.weight + other.weight
        self.moments.merge(other.moments)


@dataclass
class PatternSums:
    """All sums of one sensor's captures: per camera those of the fine and the coarse band."""

    organised_on: str
    cameras: dict[str, tuple[BandSums, BandSums]] = field(default_factory=dict)
    still: StillTexture = field(default_factory=StillTexture)

    def pattern(self, members: Iterable[str], threads: int = 1) -> FixedPattern:
        """Return the pattern that these sums tell of; `members` are the names of their captures."""
        stood_still = self.still.share()
        shares = {
            name: self.still.at_camera(stood_still, fine.moments.shape, own=name == self.organised_on)
            for name, (fine, _) in self.cameras.items()
        }

        def band(name: str, index: int) -> BandPattern:
            sums = self.cameras[name][index]
            maps = sums.weighted_sum, sums.weight
            return BandPattern(*maps, *pattern_variances(sums.moments, *maps, shares[name], BAND_CELLS_PX[index]))

        jobs = [partial(band, name, index) for name in self.cameras for index in range(len(BAND_CELLS_PX))]
        made = iter(side_by_side(jobs, threads))
        return FixedPattern(
            {name: CameraPattern((next(made), next(made))) for name in self.cameras}, frozenset(members)
        )


def sum_captures(
    taken: Iterable[Measurement], options: PhotometricOptions | None = None, threads: int | None = None
) -> PatternSums:
    """Return the sums over captures of one sensor, in their order; one of them at a time is looked at."""
    options, count = options or PhotometricOptions(), thread_count(threads)
    sums: PatternSums | None = None
    for measurement in taken:
        sums = sums or PatternSums(measurement.organised_on)
        _add(sums, measurement, options, count)
    if sums is None:
        raise InputError("captures", "found none", "at least one")
    return sums


def add_sums(parts: Iterable[PatternSums]) -> PatternSums:
    """Return the sums over all captures of several sums, added in their order; the first one is used up."""
    remaining = iter(parts)
    first = next(remaining)
    for other in remaining:
        for name, bands in other.cameras.items():
            for own, more in zip(first.cameras[name], bands, strict=True):
                own.merge(more)
        first.still.merge(other.still)
    return first


def _add(sums: PatternSums, measurement: Measurement, options: PhotometricOptions, threads: int) -> None:
    # What the organising camera sees tells what stood still, also where only the other one serves as texture.
    names = tuple(dict.fromkeys((*measurement.texture_views, measurement.organised_on)))
    # Cameras side by side: much of each is too small to be shared out by rows.
    own = max(1, threads // len(names))
    lowpass = Lowpass.of(options.shading_mm / ground_sample_distance(measurement), own)
    for name in names:
        width, height = measurement.rig.cameras[name].size_px
        if name not in sums.cameras:
            sums.cameras[name] = BandSums.of((height, width)), BandSums.of((height, width))

    def add_camera(name: str) -> tuple[Map, Map]:
        """Add what a camera saw; return its contrast and which blocks count."""
        seen = camera_contrast(measurement, name, lowpass, options.max_contrast)
        counted = counted_blocks(measurement, name)
        noise, _ = _core.block_sums(seen.variance, -np.inf, np.inf, EVERYWHERE, BLOCK_PX, own)
        for band, part, share in zip(sums.cameras[name], split_bands(seen.value, own), BAND_NOISE, strict=True):
            band.add(part, noise * np.float32(share), counted, own)
        return seen.value, counted

    found = dict(zip(names, side_by_side([partial(add_camera, name) for name in names], threads), strict=True))
    value, counted = found[measurement.organised_on]
    weight = pattern_weights(*block_moments(value, threads)) * counted
    sums.still.add(measurement, {name: seen for name, (seen, _) in found.items()}, weight)
