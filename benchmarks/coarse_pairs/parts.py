"""Parts for the statistics of the coarse registration: several captures of each, placed so that most pairs overlap.

A part is drawn from its number alone, so that a run can be resumed and extended: surface, density and grain of its
texture and highlights by a Halton sequence; each capture has its own roll, tilt, distance, lamp and exposure. All
pairs of its captures are cases; they share the part's texture and the sensor, not noise and geometry. The overlap is
that of DESIGN: the share of the smaller area that both measurements see, planned here from the frusta of cameras and
projector.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import combinations

import numpy as np
from scipy.stats import qmc

from planish.errors import InputError
from planish.geometry import Array, invert, transform_points
from planish.measurement import Measurement
from planish.rig import Rig
from planish.simulation.light import Lamp
from planish.simulation.scenes import Scene, make_scene, place_sensor
from planish.simulation.surfaces import Surface
from shared.rendered import measure_scene

SURFACES = ("door", "plate", "cylinder", "pipe", "waves")
CAPTURES = 6
#: Overlaps of the statistics; the plan may miss the measured one by PLAN_ERROR.
OVERLAPS, PLAN_ERROR = (0.15, 0.70), 0.03
#: Tilts of single captures and the largest between two of a case [deg]; distances [mm]: 8 % of 838; exposures.
TILT_DEG, MAX_TILT_DEG, CLOSER_MM, EXPOSURES = 16.0, 25.0, 66.0, (0.5, 1.4)
#: Plans that are tried for a part, and the distances [mm] of their captures from a middle.
PLANS, REACH_MM = 40, (80.0, 230.0)
#: Samples per pixel and axis at half resolution: with 3 the images differ from those with 8 by 0.01 to 0.05 % of their
#: grey values, a tenth of the noise of the mean of all images; with 2 by 0.7 %.
HALF_SAMPLES = 3
#: Every so many pixels of the organising camera at half resolution a ray serves for the overlap.
RAY_STRIDE = 24
#: Surfaces seen flatter than this are not measured [cosine].
GRAZING = 0.25


@dataclass(frozen=True)
class Stand:
    """Where a capture was taken, and in what light."""

    s: float
    t: float
    roll_deg: float
    tilt_deg: tuple[float, float]
    closer_mm: float
    lamp: float = 0.0
    lamp_direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    exposure: float = 1.0

    def place(self, surface: Surface) -> Array | None:
        """Return T_object_sensor (4, 4), or None beside the part."""
        try:
            return place_sensor(surface, self.s, self.t, self.roll_deg, self.tilt_deg, self.closer_mm)
        except InputError:
            return None


@dataclass(frozen=True)
class Part:
    """What makes up one part: its surface, its texture, and where its captures stand."""

    number: int
    surface: str
    density: float
    grain: float
    specular: float
    scale: float
    stands: tuple[Stand, ...] = ()

    def scene(self) -> Scene:
        """Return the scene without the captures' own light and exposure."""
        scene = make_scene(
            self.surface, self.number, 2, grain=self.grain, texture_density=self.density, scale=self.scale
        )
        light = replace(scene.light, specular=self.specular)
        samples = HALF_SAMPLES if self.scale == 0.5 else scene.sensor.samples_per_px
        scene = replace(scene, light=light, sensor=replace(scene.sensor, samples_per_px=samples))
        places = [stand.place(scene.surface) for stand in self.stands]
        return scene.seen_from([T for T in places if T is not None])


@dataclass(frozen=True)
class Case:
    """One pair of captures of a part, as it was planned."""

    first: int
    second: int
    planned_overlap: float


def draw_part(number: int, scale: float = 0.5) -> tuple[Part, list[Case]]:
    """Return the part of a number and its cases."""
    engine = qmc.Halton(4, scramble=True, rng=2016)
    engine.fast_forward(number)
    x = engine.random(1)[0]
    # Reach: parts whose captures stand close to each other make up for the large overlaps.
    part = Part(
        number=number,
        surface=SURFACES[number % len(SURFACES)],
        density=round(0.1 + 0.9 * x[0], 4),
        grain=round(0.03 * x[1], 5),
        specular=round(0.06 * x[2], 4),
        scale=scale,
    )
    return plan(part, CAPTURES, OVERLAPS, np.random.default_rng([number, 7]), REACH_MM, TILT_DEG)


def plan(
    part: Part,
    captures: int,
    overlaps: tuple[float, float],
    rng: np.random.Generator,
    reach_mm: tuple[float, float],
    tilt_deg: float,
    plans: int = PLANS,
) -> tuple[Part, list[Case]]:
    """Return the part with stands such that many pairs have overlaps in the range, evenly spread, and these pairs."""
    scene = part.scene()
    best: tuple[float, tuple[Stand, ...], list[Case]] = (-1.0, (), [])
    for _ in range(plans):
        stands = _draw_stands(scene.surface, captures, rng, rng.uniform(*reach_mm), tilt_deg)
        cases = find_cases(scene.surface, scene.rig, stands, overlaps)
        counts, _ = np.histogram([case.planned_overlap for case in cases], bins=4, range=overlaps)
        value = float(np.sqrt(counts).sum())
        if value > best[0]:
            best = (value, stands, cases)
    return replace(part, stands=best[1]), best[2]


def find_cases(surface: Surface, rig: Rig, stands: tuple[Stand, ...], overlaps: tuple[float, float]) -> list[Case]:
    """Return the pairs of captures whose planned overlap lies in the range and that are not tilted too far."""
    places = [stand.place(surface) for stand in stands]
    views = [None if T is None else Seen.of(surface, rig, T) for T in places]
    cases = []
    for i, j in combinations(range(len(stands)), 2):
        a, b = views[i], views[j]
        tilt = np.hypot(*np.subtract(stands[i].tilt_deg, stands[j].tilt_deg))
        if a is None or b is None or tilt > MAX_TILT_DEG:
            continue
        overlap = seen_overlap(a, b)
        if overlaps[0] - PLAN_ERROR <= overlap <= overlaps[1] + PLAN_ERROR:
            cases.append(Case(i, j, round(overlap, 3)))
    return cases


def measure_part(part: Part) -> dict[int, Measurement]:
    """Render and measure the captures of a part; one that cannot be measured is left out."""
    scene, found = part.scene(), {}
    for index, stand in enumerate(part.stands):
        lamp = Lamp(stand.lamp, stand.lamp_direction) if stand.lamp > 0 else None
        seen = replace(
            scene,
            light=replace(scene.light, lamp=lamp),
            sensor=replace(scene.sensor, exposure=stand.exposure),
        )
        try:
            found[index] = measure_scene(seen, index)
        except InputError as error:
            print(f"part {part.number}, capture {index}: {error}", flush=True)
    return found


def true_transform(part: Part, case: Case) -> Array:
    """Return the true T_a_b (4, 4) of a case."""
    surface = part.scene().surface
    a, b = (part.stands[i].place(surface) for i in (case.first, case.second))
    assert a is not None
    assert b is not None
    return invert(a) @ b


def describe_case(part: Part, case: Case) -> dict[str, object]:
    """Return what distinguishes a case, for JSON."""
    values = asdict(part) | {"first": case.first, "second": case.second, "planned_overlap": case.planned_overlap}
    del values["stands"]
    a, b = part.stands[case.first], part.stands[case.second]
    values["roll_deg"] = round((b.roll_deg - a.roll_deg) % 360, 1)
    values["tilt_deg"] = round(float(np.hypot(*np.subtract(a.tilt_deg, b.tilt_deg))), 1)
    values["closer_mm"] = (a.closer_mm, b.closer_mm)
    values["lamp"] = (a.lamp, b.lamp)
    values["exposure"] = (a.exposure, b.exposure)
    return values


def _draw_stands(
    surface: Surface, count: int, rng: np.random.Generator, reach_mm: float, tilt_deg: float
) -> tuple[Stand, ...]:
    # The seam of a pipe lies opposite to its middle: no part of it is looked at.
    half = np.array([min(surface.half_s, 1.3 * getattr(surface, "radius", np.inf)), surface.half_t])
    room = np.maximum(half - 130.0, 20.0)
    middle = rng.uniform(-1, 1, 2) * np.maximum(room - reach_mm, 0)
    stands = []
    for k in range(count):
        # Around the middle in turn: equal directions would put captures on top of each other.
        angle = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count
        at = middle + reach_mm * rng.uniform(0.5, 1.0) * np.array([np.cos(angle), np.sin(angle)])
        s, t = np.clip(at, -room, room)
        tilt, around = tilt_deg * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        lamp = max(0.0, 0.4 * rng.uniform(-1, 1))
        stands.append(
            Stand(
                s=round(float(s), 2),
                t=round(float(t), 2),
                roll_deg=round(rng.uniform(0, 360), 2),
                tilt_deg=(round(tilt * np.cos(around), 2), round(tilt * np.sin(around), 2)),
                closer_mm=round(rng.uniform(-CLOSER_MM, CLOSER_MM), 1),
                lamp=round(lamp, 4),
                lamp_direction=(*(round(v, 3) for v in rng.uniform(-1, 1, 2)), 1.0),
                exposure=round(float(np.exp(rng.uniform(*np.log(EXPOSURES)))), 4),
            )
        )
    return tuple(stands)


@dataclass(frozen=True)
class Seen:
    """What one sensor sees of a surface, by rays of its organising camera, with the area that each stands for."""

    rig: Rig
    T_object_sensor: Array
    points: Array
    normals: Array
    area: Array

    @classmethod
    def of(cls, surface: Surface, rig: Rig, T_object_sensor: Array) -> Seen:
        """Cast rays from a sensor and keep those that are lit."""
        camera = rig.cameras["A"]
        stride = RAY_STRIDE * camera.size_px[0] / 694
        u, v = np.meshgrid(*(np.arange(stride / 2, n, stride) for n in camera.size_px))
        directions = camera.rays_sensor(np.stack([u, v], -1).reshape(-1, 2)) @ T_object_sensor[:3, :3].T
        origin = transform_points(T_object_sensor, camera.center_sensor)
        points, normals, _ = surface.intersect(np.broadcast_to(origin, directions.shape), directions)
        hit = np.isfinite(points[:, 0])
        hit[hit] = _visible(points[hit], normals[hit], rig, T_object_sensor)
        points, normals, directions = points[hit], normals[hit], directions[hit]
        # Area of a pixel's footprint: distance squared over the cosine of incidence, up to a constant.
        cosine = -(directions * normals).sum(1) / np.linalg.norm(directions, axis=1)
        area = ((points - origin) ** 2).sum(1) / np.maximum(cosine, GRAZING)
        return cls(rig, T_object_sensor, points, normals, area)

    def area_seen_by(self, other: Seen) -> float:
        """Return the area that another sensor sees too."""
        return float(self.area[_visible(self.points, self.normals, other.rig, other.T_object_sensor)].sum())


def seen_overlap(a: Seen, b: Seen) -> float:
    """Return the overlap of two sensors: the area that both see over the smaller area that one sees."""
    smaller = min(a.area.sum(), b.area.sum())
    return a.area_seen_by(b) / float(smaller) if smaller > 0 else 0.0


def _visible(points: Array, normals: Array, rig: Rig, T_object_sensor: Array) -> np.ndarray:
    sensor = transform_points(invert(T_object_sensor), points)
    seen = np.ones(len(points), bool)
    assert rig.projector is not None
    # Where the other camera sees nothing, camera and projector give the point.
    for device in (rig.cameras["A"], rig.projector):
        pixels = device.project(sensor)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= 0).all(1) & (pixels <= np.array(device.size_px) - 1).all(1)
        towards = transform_points(T_object_sensor, device.center_sensor) - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        seen &= inside & ((towards * normals).sum(1) > GRAZING)
    return seen
