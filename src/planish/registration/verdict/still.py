"""What stands still in the image belongs to the sensor, or to a background that does not move with the part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planish.measurement import Measurement
from planish.registration.matches import Matches


def same_sensor(a: Measurement, b: Measurement) -> bool:
    """Return whether both were taken by the same camera, so that what is fixed to it stands at the same pixels."""
    return (
        a.organised_on == b.organised_on
        and a.shape == b.shape
        and np.array_equal(a.camera.kernel_parameters[:17], b.camera.kernel_parameters[:17])
    )


def standing_still(matches: Matches, still_px: float) -> NDArray[np.bool_]:
    """Return per match (M,) whether its pixel is the same in both images."""
    moved = np.linalg.norm(matches.pixels_a - matches.pixels_b, axis=1)
    return np.asarray(moved < still_px)
