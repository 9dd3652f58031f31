"""Pixel pairs of a rig without images: points of a volume as two devices see them, with noise."""

import numpy as np

from planish.rig import Rig
from planish.sensing.rigcheck.pairs import PixelPairs

#: Half sides of the volume that the points fill [mm].
VOLUME_MM = (110.0, 80.0, 60.0)


def pairs_of(true: Rig, rng, count=300, sigma_px=0.05, own="A", other="B", depth_mm=VOLUME_MM[2], name="m"):
    """What the devices of the rig `true` see of points of a volume, and what a measurement knows of them."""
    points = rng.uniform(-1, 1, (count, 3)) * (*VOLUME_MM[:2], depth_mm)
    own_px, there = (true.devices[device].project(points) for device in (own, other))
    there = there + rng.standard_normal((count, 2)) * sigma_px
    return PixelPairs(name, "simulated", own, other, own_px, there, there, points, np.full(count, sigma_px), count)
