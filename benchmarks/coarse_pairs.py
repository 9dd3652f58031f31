"""Pairs of measurements for the statistics of the coarse registration, drawn over all that changes between them.

A pair is drawn from its number alone, so that a run can be resumed and extended. The overlap is that of DESIGN: the
part of the smaller area that both measurements see, found here from the frusta of cameras and projector.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import qmc

from planish.geometry import Array, compose, exp_so3, invert, transform_points
from planish.measurement import Measurement
from planish.pipeline import measure
from planish.rig import Rig
from planish.sensing.capture.manifest import Capture
from planish.simulation.light import Lamp
from planish.simulation.scenes import Scene, make_scene
from planish.simulation.surfaces import Surface
from planish.simulation.writing import write_scene

SURFACES = ("door", "plate", "cylinder", "pipe", "waves")
#: Every so many pixels of the organising camera a ray serves for the overlap.
RAY_STRIDE = 24
#: Surfaces seen flatter than this are not measured [cosine].
GRAZING = 0.25


@dataclass(frozen=True)
class PairCase:
    """What makes up one pair."""

    number: int
    surface: str
    overlap: float
    density: float
    grain: float
    roll_deg: float
    tilt_deg: tuple[float, float]
    closer_mm: float
    specular: float
    lamp: float
    exposure: float
    direction_deg: float
    scale: float

    def to_json(self) -> dict[str, object]:
        """Return the case as it is saved."""
        return asdict(self)


def draw_case(number: int, scale: float = 0.5) -> PairCase:
    """Return the pair of a number: a Halton sequence over all that changes, the surfaces in turn."""
    engine = qmc.Halton(12, scramble=True, rng=2016)
    engine.fast_forward(number)
    x = engine.random(1)[0]
    tilt, around = 25 * np.sqrt(x[4]), 2 * np.pi * x[5]
    return PairCase(
        number=number,
        surface=SURFACES[number % len(SURFACES)],
        overlap=round(0.15 + 0.55 * x[0], 4),
        density=round(0.1 + 0.9 * x[1], 4),
        grain=round(0.03 * x[2], 5),
        roll_deg=round(360 * x[3], 2),
        tilt_deg=(round(tilt * np.cos(around), 2), round(tilt * np.sin(around), 2)),
        closer_mm=round(66 * (2 * x[6] - 1), 1),
        specular=round(0.06 * x[7], 4),
        lamp=round(max(0.0, 0.4 * (2 * x[8] - 1)), 4),
        exposure=round(float(np.exp(np.log(2) * (2 * x[9] - 1))), 4),
        direction_deg=round(360 * x[10], 2),
        scale=scale,
    )  # fmt: skip


def make_pair(case: PairCase) -> tuple[Scene, Scene] | None:
    """Return the scenes of both captures (of the second, capture 1 counts), or None where the part is too small."""
    scene = make_scene(case.surface, case.number, 2, grain=case.grain, texture_density=case.density, scale=case.scale)
    places = _places(case, scene)
    if places is None:
        return None
    first = replace(scene.seen_from(places), light=replace(scene.light, specular=case.specular))
    other = first.light
    if case.lamp > 0:
        rng = np.random.default_rng(case.number)
        direction = (*rng.uniform(-1, 1, 2), 1.0)
        other = replace(other, lamp=Lamp(case.lamp, direction))
    return first, replace(first, light=other, sensor=replace(first.sensor, exposure=case.exposure))


def measure_pair(pair: tuple[Scene, Scene], folder: Path) -> tuple[Measurement, Measurement]:
    """Render and measure both captures."""
    out = []
    for number, scene in enumerate(pair):
        (path,) = write_scene(scene, folder / str(number), true_points=False, only=(number,))
        out.append(measure(Capture.load(path)))
    return out[0], out[1]


def true_transform(scene: Scene) -> Array:
    """Return the true T_a_b (4, 4)."""
    return invert(scene.T_object_sensor[0]) @ scene.T_object_sensor[1]


def _places(case: PairCase, scene: Scene) -> tuple[Array, Array] | None:
    rng = np.random.default_rng([case.number, 7])
    surface = scene.surface
    reach = np.array([min(surface.half_s, 1.2 * getattr(surface, "radius", np.inf)), surface.half_t]) - 150.0
    start = rng.uniform(-1, 1, 2) * np.maximum(reach, 0) * 0.6
    angle = np.deg2rad(case.direction_deg)
    along = np.array([np.cos(angle), np.sin(angle)])
    # Back towards the middle of the part: there is room.
    if start @ along > 0:
        along = -along
    roll = rng.uniform(0, 360)
    a = _look_at(surface, start, roll, (0.0, 0.0), 0.0)
    low, high = 0.0, 420.0
    for _ in range(18):
        middle = 0.5 * (low + high)
        b = _look_at(surface, start + middle * along, roll + case.roll_deg, case.tilt_deg, case.closer_mm)
        if b is None or seen_overlap(surface, scene.rig, a, b) < case.overlap:
            high = middle
        else:
            low = middle
    b = _look_at(surface, start + low * along, roll + case.roll_deg, case.tilt_deg, case.closer_mm)
    if b is None or abs(seen_overlap(surface, scene.rig, a, b) - case.overlap) > 0.03:
        return None
    return a, b


def _look_at(
    surface: Surface, at: Array, roll_deg: float, tilt_deg: tuple[float, float], closer_mm: float
) -> Array | None:
    if abs(at[0]) >= surface.half_s or abs(at[1]) >= surface.half_t:
        return None
    point, normal = surface.point_and_normal(*at)
    x = np.cross([0.0, 1.0, 0.0], normal)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(normal, x), normal])
    R = R @ exp_so3([0, 0, np.deg2rad(roll_deg)]) @ exp_so3([*np.deg2rad(tilt_deg), 0])
    return compose(R, point - closer_mm * R[:, 2])


def seen_overlap(surface: Surface, rig: Rig, T_object_a: Array, T_object_b: Array) -> float:
    """Return the overlap of two sensors: the area that both see over the smaller area that one sees."""
    areas, common = [], []
    for own, other in ((T_object_a, T_object_b), (T_object_b, T_object_a)):
        points, normals, area = _seen(surface, rig, own)
        areas.append(area.sum())
        common.append(area[_visible(points, normals, rig, other)].sum())
    return float(common[0] / min(areas)) if min(areas) > 0 else 0.0


def _seen(surface: Surface, rig: Rig, T_object_sensor: Array) -> tuple[Array, Array, Array]:
    camera = rig.cameras["A"]
    u, v = np.meshgrid(*(np.arange(RAY_STRIDE / 2, n, RAY_STRIDE) for n in camera.size_px))
    directions = camera.rays_sensor(np.stack([u, v], -1).reshape(-1, 2)) @ T_object_sensor[:3, :3].T
    origin = transform_points(T_object_sensor, camera.center_sensor)
    points, normals, _ = surface.intersect(np.broadcast_to(origin, directions.shape), directions)
    hit = np.isfinite(points[:, 0])
    points, normals, directions = points[hit], normals[hit], directions[hit]
    seen = _visible(points, normals, rig, T_object_sensor)
    points, normals, directions = points[seen], normals[seen], directions[seen]
    # Area of a pixel's footprint: distance squared over the cosine of incidence, up to a constant.
    distance2 = ((points - origin) ** 2).sum(1)
    cosine = -(directions * normals).sum(1) / np.linalg.norm(directions, axis=1)
    return points, normals, distance2 / np.maximum(cosine, GRAZING)


def _visible(points: Array, normals: Array, rig: Rig, T_object_sensor: Array) -> np.ndarray:
    sensor = transform_points(invert(T_object_sensor), points)
    seen = np.ones(len(points), bool)
    for device in rig.devices.values():
        pixels = device.project(sensor)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= 0).all(1) & (pixels <= np.array(device.size_px) - 1).all(1)
        towards = transform_points(T_object_sensor, device.center_sensor) - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        seen &= inside & ((towards * normals).sum(1) > GRAZING)
    return seen
