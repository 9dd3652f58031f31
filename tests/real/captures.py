"""Real captures, recorded by others; they are not part of this repository."""

import os
from pathlib import Path

import numpy as np
import pytest

from planish.measurement import Measurement
from planish.pipeline import MeasureOptions, measure
from planish.sensing.capture.manifest import Capture
from spread import robust_spread

HERE = Path(__file__).parent


def load(name: str, manifest: str = "capture.json") -> Capture:
    """The capture with its manifest here, its images in the data folder; skips the test where that is absent."""
    folder = Path(os.environ.get("PLANISH_DATA", HERE.parents[2] / "shared" / "data")) / name
    if not folder.is_dir():
        pytest.skip(f"real data not present: {folder} (set PLANISH_DATA to the folder that holds {name})")
    return Capture.load(HERE / name / manifest, folder)


def measured(name: str, **options) -> Measurement:
    return measure(load(name), MeasureOptions(**options), 2)


def plane_spread(points) -> float:
    """Robust standard deviation [mm] of points (N, 3) along the normal of their plane, fitted without outliers."""
    points = points.astype(float)
    use = np.ones(len(points), bool)
    for _ in range(5):
        center = points[use].mean(0)
        normal = np.linalg.svd(points[use] - center, full_matrices=False)[2][2]
        distance = (points - center) @ normal
        use = np.abs(distance) < 4 * robust_spread(distance)
    return robust_spread(distance)
