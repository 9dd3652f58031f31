"""Scenes: a part, its light, the sensor and where it stood; and the catalogue of scenes by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from planish.errors import InputError
from planish.geometry import Array, compose, exp_so3
from planish.rig import Rig
from planish.sensing.patterns.entries import Entry
from planish.sensing.patterns.sequences import reference_sequence
from planish.simulation.light import Light
from planish.simulation.printed import Print
from planish.simulation.sensor import Sensor, reference_rig
from planish.simulation.surfaces import Cylinder, Door, Pipe, Plate, Step, Surface, Waves
from planish.simulation.texture import BLANK, Grain, Marks, Texture


@dataclass(frozen=True)
class Background:
    """A textured plane z = `z_mm` of the sensor frame: it moves with the sensor, not with the part."""

    z_mm: float = -220.0
    texture: Texture = field(
        default_factory=lambda: Texture(
            albedo=0.3,
            grain=Grain(0.08, 6.0, 3.0),
            scratches=None,
            specks=Marks(4.0, 0.4, (1.0, 6.0), (1.0, 6.0), 0.4),
        )
    )


@dataclass(frozen=True)
class Scene:
    """Everything a run of captures depends on.

    Parameters
    ----------
    part : str
        Name of the part, as it stands in `truth.json`.
    surface, texture, light, sensor, background
        What is seen, by what.
    names : tuple of str
        Names of the captures.
    T_object_sensor : tuple of ndarray (4, 4)
        Per capture: maps points of the sensor frame into the object frame [mm].
    rig : Rig
        The sensor's true rig.
    sequence : tuple of Entry
        What is projected.
    seed : int
        Of texture and noise (PRNU and dust follow from `sensor.seed`).
    printed : Print or None
        What is printed on the surface, on top of its texture.
    """

    part: str
    surface: Surface
    texture: Texture
    light: Light
    sensor: Sensor
    names: tuple[str, ...]
    T_object_sensor: tuple[Array, ...]
    rig: Rig
    seed: int = 0
    background: Background | None = None
    sequence: tuple[Entry, ...] = field(default_factory=lambda: tuple(reference_sequence()))
    printed: Print | None = None

    def seen_from(self, T_object_sensor: Sequence[Array]) -> Scene:
        """Return the scene with other captures, named m1, m2, ..."""
        return replace(self, T_object_sensor=tuple(T_object_sensor), names=_names(len(T_object_sensor)))


def place_sensor(
    surface: Surface, s: float, t: float, roll_deg: float = 0.0, tilt_deg: tuple[float, float] = (0.0, 0.0),
    closer_mm: float = 0.0,
) -> Array:  # fmt: skip
    """Return T_object_sensor (4, 4) of a sensor that looks at the surface point (s, t) [mm].

    The sensor frame's z axis is the surface normal there, turned by `tilt_deg` about the sensor's x and y axes; its x
    axis is turned by `roll_deg` about the normal against the direction of s. Its origin lies `closer_mm` below the
    surface, so that the sensor is nearer to the part by that much.
    """
    point, normal = surface.point_and_normal(s, t)
    along_s = np.cross([0.0, 1.0, 0.0], normal)
    x = along_s / np.linalg.norm(along_s)
    R = np.column_stack([x, np.cross(normal, x), normal])
    R = R @ exp_so3([0, 0, np.deg2rad(roll_deg)]) @ exp_so3([*np.deg2rad(tilt_deg), 0])
    return compose(R, point - closer_mm * R[:, 2])


def make_scene(
    name: str, seed: int = 0, captures: int | None = None, *, grain: float | None = None, texture_density: float = 1.0,
    scale: float = 1.0, bits: int = 8,
) -> Scene:  # fmt: skip
    """Return a scene of the catalogue.

    Parameters
    ----------
    name : str
        One of SCENES.
    seed : int
        Of texture, noise, positions and of what is fixed to the sensor.
    captures : int, optional
        Number of captures; None = the scene's own number.
    grain : float, optional
        Rms contrast of the brushed grain; None = the scene's own.
    texture_density : float
        Multiplies the number of scratches, specks and smudges.
    scale : float
        Resolution of the cameras against the paper's.
    bits : int
        8 or 16.

    Raises
    ------
    InputError
        Where a value is out of range or the name is unknown.
    """
    _require(name in SCENES, "scene", f"'{name}'", f"one of {', '.join(SCENES)}")
    _require(captures is None or captures >= 1, "captures", captures, "a whole number >= 1")
    _require(seed >= 0, "seed", seed, "a whole number >= 0")
    _require(grain is None or 0 <= grain <= 0.2, "grain", grain, "a contrast from 0 to 0.2")
    _require(0 <= texture_density <= 100, "texture density", texture_density, "a factor from 0 to 100")
    _require(0.05 <= scale <= 2, "width scale", scale, "a factor from 0.05 to 2")
    rng = np.random.Generator(np.random.Philox(key=[seed, 3]))
    scene = SCENES[name](rng, captures)
    texture = scene.texture.with_density(texture_density)
    if grain is not None:
        texture = texture.with_grain(grain)
    # Coarse pixels hold more texture: as many samples per millimetre as at full resolution, within reason.
    sensor = replace(scene.sensor, bits=bits, seed=seed, samples_per_px=min(4, max(2, round(2 / scale))))
    return replace(scene, texture=texture, sensor=sensor, rig=reference_rig(scale), seed=seed)


def _require(condition: bool, subject: str, found: object, expected: str) -> None:
    if not condition:
        raise InputError(subject, f"found {found}", expected)


def _names(count: int) -> tuple[str, ...]:
    return tuple(f"m{i + 1}" for i in range(count))


def _scene(part: str, surface: Surface, places: Sequence[Array], texture: Texture | None = None) -> Scene:
    return Scene(
        part, surface, texture or Texture(), Light(), Sensor(), _names(len(places)), tuple(places), reference_rig()
    )  # fmt: skip


#: Rolls [deg] of consecutive captures: operators turn the sensor as the part allows.
_ROLLS = (0.0, -25.0, 35.0, 180.0, 12.0, 95.0, -60.0, 150.0)


def _walk(
    surface: Surface, path: Array, rng: np.random.Generator, rolls: Sequence[float] = _ROLLS, tilt_deg: float = 7.0,
    closer_mm: float = 15.0, jitter_mm: float = 8.0,
) -> list[Array]:  # fmt: skip
    """Return the places along a path (n, 2) in (s, t) [mm] with varied roll, tilt and distance."""
    places = []
    for i, (s, t) in enumerate(path):
        ds, dt = rng.uniform(-jitter_mm, jitter_mm, 2)
        roll = rolls[i % len(rolls)] + rng.uniform(-4, 4)
        tilt = rng.uniform(-tilt_deg, tilt_deg, 2)
        T = place_sensor(surface, s + ds, t + dt, roll, (tilt[0], tilt[1]), rng.uniform(-closer_mm, closer_mm))
        places.append(T)
    return places


def _zigzag(count: int, step_mm: float, height_mm: float, limit_mm: float) -> Array:
    """Return a path (count, 2) that goes back and forth between s = -limit_mm and limit_mm, up and down in t."""
    along = np.arange(count) * step_mm
    span = 2 * limit_mm
    s = span / 2 - np.abs(np.mod(along + max(0.0, span - step_mm * (count - 1)) / 2, 2 * span) - span)
    return np.column_stack([s, height_mm * (-1.0) ** np.arange(count)])


def _door(rng: np.random.Generator, captures: int | None) -> Scene:
    surface = Door()
    path = _zigzag(captures or 5, 165.0, 75.0, 360.0)
    return _scene("door", surface, _walk(surface, path, rng))


def _plate(rng: np.random.Generator, captures: int | None) -> Scene:
    surface = Plate()
    return _scene("plate", surface, _walk(surface, _zigzag(captures or 5, 165.0, 75.0, 330.0), rng))


def _cylinder(rng: np.random.Generator, captures: int | None) -> Scene:
    surface = Cylinder()
    path = _zigzag(captures or 5, 110.0, 85.0, 200.0)
    return _scene("cylinder", surface, _walk(surface, path, rng))


def _pipe(rng: np.random.Generator, captures: int | None) -> Scene:
    surface = Pipe()
    count = captures or 5
    # 25 degrees from one capture to the next; the seam is opposite to the middle of the walk.
    angles = np.mod(np.deg2rad(25.0) * (np.arange(count) - (count - 1) / 2) + np.pi, 2 * np.pi) - np.pi
    path = np.column_stack([surface.radius * angles, rng.uniform(-30, 30, count)])
    return _scene("pipe", surface, _walk(surface, path, rng, (0, 6, -8, 5, -3), tilt_deg=4, jitter_mm=0))


def _waves(rng: np.random.Generator, captures: int | None) -> Scene:
    surface = Waves()
    return _scene("waves", surface, _walk(surface, _zigzag(captures or 5, 165.0, 75.0, 330.0), rng))


def _step(rng: np.random.Generator, captures: int | None) -> Scene:
    surface = Step()
    path = np.column_stack([np.zeros(captures or 1), 30.0 * np.arange(captures or 1)])
    return _scene("step", surface, _walk(surface, path, rng, tilt_deg=3))


def _disjoint(rng: np.random.Generator, captures: int | None) -> Scene:
    count = captures or 2
    _require(count == 2, "captures", count, "2 in the scene 'disjoint'")
    surface = Door()
    return _scene("door", surface, _walk(surface, np.array([[-310.0, -60.0], [310.0, 60.0]]), rng, (0, 20)))


def _blank(rng: np.random.Generator, captures: int | None) -> Scene:
    surface = Plate()
    path = np.column_stack([50.0 * np.arange(captures or 2), np.zeros(captures or 2)])
    places = [place_sensor(surface, s, t) for s, t in path]
    return _scene("plate", surface, places, BLANK)


#: The catalogue.
SCENES: dict[str, Callable[[np.random.Generator, int | None], Scene]] = {
    "door": _door,
    "plate": _plate,
    "cylinder": _cylinder,
    "pipe": _pipe,
    "waves": _waves,
    "step": _step,
    "disjoint": _disjoint,
    "blank": _blank,
}
