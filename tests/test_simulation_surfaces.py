import numpy as np
import pytest

from planish.errors import InputError
from planish.simulation.surfaces import Cylinder, Door, Pipe, Plate, Step, Waves
from reference import scene_surfaces as reference

#: The intersection has to be exact to this [mm].
EXACT_MM = 1e-9
#: Central differences of the twin's normal.
NORMAL_TOLERANCE = 1e-6

SURFACES = (
    Plate(), Door(), Waves(), Cylinder(), Pipe(), Step(), Step(step=-0.5),
    Door(recess_depth=25, recess_wall=0.03), Waves(amplitude=15, wavelength=60),
)  # fmt: skip


def make_rays(surface, count, rng):
    """Rays from where cameras stand to places all over the surface, some beside it."""
    target = np.column_stack(
        [rng.uniform(-1.1, 1.1, count) * min(surface.half_s, 450), rng.uniform(-1.1, 1.1, count) * surface.half_t]
    )
    target = np.column_stack([target, np.zeros(count)])
    if isinstance(surface, Cylinder):
        target[:, 0] = rng.uniform(-1.2, 1.2, count) * surface.radius
        target[:, 2] = -surface.radius
    origin = target + np.column_stack([rng.uniform(-450, 450, (count, 2)), rng.uniform(700, 900, count)])
    return origin, (target - origin) * rng.uniform(0.2, 3, (count, 1)) / 900


@pytest.mark.parametrize("surface", SURFACES, ids=lambda s: f"{s.kind}-{hash(s) % 1000}")
def test_rays_meet_the_surface_where_an_independent_solver_finds_it(surface):
    rng = np.random.default_rng(5)
    origins, directions = make_rays(surface, 150, rng)
    points, normals, st = surface.intersect(origins, directions)
    assert np.isfinite(points[:, 0]).sum() > 50
    for origin, direction, point, normal in zip(origins, directions, points, normals, strict=True):
        length = np.linalg.norm(direction)
        distance = reference.first_hit(surface, origin, direction, 0, 1600 / length)
        expected = origin + distance * direction
        if np.isnan(point[0]):
            assert np.isnan(distance) or is_outside(surface, expected)
            continue
        assert np.abs(expected - point).max() < EXACT_MM
        assert abs(np.linalg.norm(normal) - 1) < EXACT_MM
        if not (surface.kind == "step" and abs(point[0]) < 1e-3):
            assert np.abs(reference.normal(surface, point) - normal).max() < NORMAL_TOLERANCE
    assert np.abs(st[np.isfinite(st[:, 0])]).max() <= max(surface.half_s, surface.half_t)


def is_outside(surface, point):
    s = point[0]
    if isinstance(surface, Cylinder):
        s = surface.radius * np.arctan2(point[0], point[2] + surface.radius)
    ds, dt = abs(s) - surface.half_s, abs(point[1]) - surface.half_t
    in_corner = ds + surface.corner > 0 and dt + surface.corner > 0
    return ds > 0 or dt > 0 or (in_corner and np.hypot(ds + surface.corner, dt + surface.corner) > surface.corner)


def test_a_ray_that_crosses_several_waves_stops_at_the_first():
    surface = Waves(amplitude=15, wavelength=60)
    origin, direction = np.array([[-400.0, 3.0, 120.0]]), np.array([[1.0, 0.0, -0.25]])
    point = surface.intersect(origin, direction)[0][0]
    distance = reference.first_hit(surface, origin[0], direction[0], 0, 600, samples=200_000)
    assert np.abs(point - (origin[0] + distance * direction[0])).max() < EXACT_MM


@pytest.mark.parametrize("s", [-460.0, -20.0, 0.0, 333.0])
def test_arc_length_on_the_pipe_is_its_surface_coordinate(s):
    pipe = Pipe()
    point, normal = pipe.point_and_normal(s, 12.0)
    angle = s / pipe.radius
    expected = [pipe.radius * np.sin(angle), 12.0, pipe.radius * (np.cos(angle) - 1)]
    assert np.abs(point - expected).max() < EXACT_MM
    assert np.abs(normal - [np.sin(angle), 0, np.cos(angle)]).max() < EXACT_MM


def test_a_place_beside_the_surface_is_refused():
    with pytest.raises(InputError, match="a point of the plate"):
        Plate().point_and_normal(600.0, 0.0)
