"""Lengths of a run from its ground sample distance: the pitch of its texture images, the scale of its options."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from planish.measurement import Measurement
from planish.registration.tiles import ground_sample_distance

#: Pitch of the texture images in multiples of the ground sample distance: the detector doubles the image, so that its
#: finest scale is near the camera's own resolution.
_PITCH_GSD = 1.5
#: Ground sample distance that the default lengths of the options are made for [mm per pixel].
REFERENCE_GSD_MM = 0.33


def median_gsd(gsds_mm: Iterable[float]) -> float:
    """Return the ground sample distance of a run [mm per pixel] from those of its measurements (NaN where unknown)."""
    known = [g for g in gsds_mm if np.isfinite(g)]
    return float(np.median(known)) if known else REFERENCE_GSD_MM


def common_gsd(measurements: Sequence[Measurement]) -> float:
    """Return the median ground sample distance of a run [mm per pixel], so that keypoints of all compare."""
    return median_gsd(map(ground_sample_distance, measurements))


def texture_pitch(gsd_mm: float) -> float:
    """Return the pitch of the texture images [mm] of a run of this ground sample distance [mm per pixel]."""
    return _PITCH_GSD * gsd_mm


def common_pitch(measurements: Sequence[Measurement]) -> float:
    """Return the pitch of the texture images of a run [mm]."""
    return texture_pitch(common_gsd(measurements))


def length_factor(gsd_mm: float) -> float:
    """Return by how much lengths of the options grow for a ground sample distance, in steps of a quarter octave.

    Steps, so that one more measurement does not change every option a little.
    """
    return float(2.0 ** (round(4 * np.log2(gsd_mm / REFERENCE_GSD_MM)) / 4))
