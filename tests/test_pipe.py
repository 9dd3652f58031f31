"""A pipe around its circumference: only texture holds the turn about its axis, and no capture sees more than a part."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from planish.geometry import Array, invert, transform_points
from planish.pipeline import measure, register
from planish.sensing.capture.manifest import Capture
from planish.simulation.scenes import Scene, make_scene, place_sensor
from planish.simulation.writing import write_scene

#: Error of a place anywhere on a capture [mm], at 1 mm per pixel and 0.65 mm per pixel.
COARSE_PIXELS_MM, FINER_PIXELS_MM = 1.0, 0.3


def around(angles_deg: Array, scale: float) -> Scene:
    scene = make_scene("pipe", 1, scale=scale)
    rng = np.random.default_rng(1)
    places = [
        place_sensor(
            scene.surface, np.deg2rad(angle) * 150.0, rng.uniform(-30, 30), rng.uniform(0, 360),
            (rng.uniform(-8, 8), rng.uniform(-8, 8)), rng.uniform(-20, 20),
        )
        for angle in angles_deg
    ]  # fmt: skip
    return scene.seen_from(places)


def registered_errors(scene: Scene, folder: Path) -> tuple[list[float], set[frozenset[str]]]:
    """Largest errors [mm] of all measurements against the reference, and the pairs that were accepted."""
    captures = write_scene(scene, folder, true_points=False)
    measurements = [measure(Capture.load(path)) for path in captures]
    result = register(measurements)
    assert len(result.groups) == 1
    true = dict(zip(scene.names, scene.T_object_sensor, strict=True))
    errors = []
    for placed, m in zip(result.measurements, sorted(measurements, key=lambda m: m.name), strict=True):
        assert placed.name == m.name
        points = m.points_sensor[m.valid][::50].astype(float)
        expected = transform_points(invert(true[result.groups[0].reference]) @ true[m.name], points)
        found = transform_points(placed.T_world_measurement, points)
        errors.append(float(np.sqrt(((found - expected) ** 2).sum(1).mean())))
    return errors, {frozenset((pair.a, pair.b)) for pair in result.pairs if pair.status == "accepted"}


def test_neighbours_on_a_pipe_register_from_any_roll(tmp_path):
    scene = around(np.array([0.0, 35.0, 70.0]), 0.3)
    errors, accepted = registered_errors(scene, tmp_path)
    assert max(errors) < COARSE_PIXELS_MM
    assert {frozenset(pair) for pair in pairwise(scene.names)} <= accepted


@pytest.mark.slow
def test_ten_captures_close_around_the_pipe(tmp_path):
    scene = around(np.arange(-162.0, 180.0, 36.0), 0.5)
    errors, accepted = registered_errors(scene, tmp_path)
    neighbours = {frozenset(pair) for pair in pairwise((*scene.names, scene.names[0]))}
    assert neighbours <= accepted
    assert max(errors) < FINER_PIXELS_MM
