"""Pairs for the statistics of the refinement: two captures each, half of the smaller one's area in common.

A pair is drawn from its scene's name and a number alone: positions, marks, grain, noise and the sensor's fixed pattern
differ from number to number, so that pairs are independent of each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coarse_pairs.parts import Case, Part, plan
from planish.simulation.scenes import Scene


@dataclass(frozen=True)
class Kind:
    """What pairs of one scene have in common."""

    surface: str
    grain: float
    density: float = 0.5
    specular: float = 0.03


#: By name. The first has nothing that is not in the bound: neither highlight nor relief.
KINDS = {
    "plate_3": Kind("plate", 0.03, specular=0.0),
    "plate_1": Kind("plate", 0.01),
    "plate_0.5": Kind("plate", 0.005),
    "cylinder_3": Kind("cylinder", 0.03),
    "door_3": Kind("door", 0.03),
    "door_0.5": Kind("door", 0.005),
    "waves_3": Kind("waves", 0.03),
    "pipe_3": Kind("pipe", 0.03),
}
#: Overlaps, largest tilt [deg] and distance of the captures from their middle [mm].
OVERLAPS, TILT_DEG, REACH_MM = (0.4, 0.6), 12.0, (60.0, 150.0)
#: Plans that are tried until one fits.
PLANS = 20


def draw_pair(kind: str, number: int, scale: float = 1.0) -> tuple[Part, Case]:
    """Return the part of a pair, seen by two captures, and the pair."""
    known = KINDS[kind]
    seed = 10_000 * (1 + list(KINDS).index(kind)) + number
    part = Part(seed, known.surface, known.density, known.grain, known.specular, scale)
    rng = np.random.default_rng([seed, 13])
    for _ in range(PLANS):
        planned, cases = plan(part, 2, OVERLAPS, rng, REACH_MM, TILT_DEG, plans=1)
        if cases:
            return plain(planned), cases[0]
    raise RuntimeError(f"no plan of {PLANS} gives {kind} {number} an overlap of {OVERLAPS}")


def plain(part: Part) -> Part:
    """Return the part in the sensor's own light, with one exposure."""
    return replace(part, stands=tuple(replace(stand, lamp=0.0, exposure=1.0) for stand in part.stands))


def with_noise(scene: Scene, factor: float) -> Scene:
    """Return the scene with the camera's noise multiplied."""
    return replace(scene, sensor=replace(scene.sensor, noise_factor=factor))
