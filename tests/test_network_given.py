"""What is given from outside: known points, a robot's transforms, a surface; tested, never trusted blindly."""

from __future__ import annotations

import numpy as np
import pytest

from networks.drawn import draw_pairs, misplaced, panel, shift, unused
from planish.geometry import compose, difference, exp_se3, exp_so3, invert, perturb, transform_points
from planish.registration.network.build import build_network
from planish.registration.network.given import Given, RobotTransform, Target
from planish.registration.network.surface_fit import (
    held_directions,
    sample_cloud,
    sample_mesh,
    surface_hold,
    surface_relation,
)

#: Place of the part in the frame of known points, of a robot or of CAD.
T_WORLD_OBJECT = exp_se3([0.3, -0.2, 1.0, 500.0, -300.0, 800.0])
POINT_SIGMA, WORLD_SIGMA = 0.02, 0.01


def known_points(truth, count=12, seed=0, wrong=None):
    """Targets on the panel, each seen by the measurement nearest to it; `wrong` names a target that is 3 mm off."""
    rng = np.random.default_rng([seed, 1])
    centres = {n: transform_points(T, truth.centroids[n]) for n, T in truth.T.items()}
    corners = np.array(list(centres.values()))
    world, seen = {}, {}
    for k in range(count):
        place = rng.uniform(corners.min(0), corners.max(0))
        name = min(centres, key=lambda n: np.linalg.norm(centres[n] - place))
        there = transform_points(T_WORLD_OBJECT, place) + WORLD_SIGMA * rng.standard_normal(3)
        here = transform_points(invert(truth.T[name]), place) + POINT_SIGMA * rng.standard_normal(3)
        label = f"T{k}"
        here = here + np.array([3.0, 0, 0]) if label == wrong else here
        world[label] = Target(label, there, WORLD_SIGMA)
        seen.setdefault(name, []).append(Target(label, here, POINT_SIGMA))
    return Given(world_targets=world, seen_targets=seen)


def robot(truth, sigma_mm=1.0, sigma_rad=2e-3, seed=0, wrong=None):
    """A robot's transforms with drawn errors; `wrong` maps a name to an additional shift [mm]."""
    rng, out = np.random.default_rng([seed, 2]), {}
    C = np.diag([sigma_rad**2] * 3 + [sigma_mm**2] * 3)
    for name in sorted(truth.T):
        T = T_WORLD_OBJECT @ truth.T[name]
        xi = np.sqrt(np.diag(C)) * rng.standard_normal(6)
        xi[3:] += (wrong or {}).get(name, np.zeros(3))
        out[name] = RobotTransform(perturb(T, -xi, T[:3, 3]), C, T[:3, 3])
    return out


def test_known_points_make_their_frame_the_world_and_the_errors_are_as_stated():
    values = []
    for seed in range(20):
        truth = panel(4, 3, seed)
        result = build_network(truth.nodes(), draw_pairs(truth, seed), given=known_points(truth, seed=seed))
        (frame,) = result.network.frames
        assert (frame.kind, frame.is_world) == ("given", True)
        np.testing.assert_array_equal(frame.T_world_frame, np.eye(4))
        xi = misplaced(truth, result.measurements, T_WORLD_OBJECT)
        for m in result.measurements:
            values.append(xi[m.name] @ np.linalg.solve(m.covariance_noise, xi[m.name]) / 6)
        assert all(test.used for test in result.network.given)
    # The frame's error is common to all measurements of a network: 20 draws of six know the mean to 13 %.
    assert np.mean(values) == pytest.approx(1, abs=0.4)


def test_a_wrong_known_point_is_named_and_ignored():
    truth = panel(4, 3)
    result = build_network(truth.nodes(), draw_pairs(truth), given=known_points(truth, wrong="T5"))
    assert [test.target for test in result.network.given if not test.used] == ["T5"]
    (sentence,) = [w for w in result.network.warnings if "T5" in w]
    assert "ignored" in sentence
    xi = misplaced(truth, result.measurements, T_WORLD_OBJECT)
    assert max(np.linalg.norm(x[3:]) for x in xi.values()) < 0.1


def test_points_in_other_units_fix_no_frame_and_are_named():
    """Global coordinates in inches: each point contradicts the others, and what is left holds nothing."""
    truth = panel(4, 3)
    given = known_points(truth, count=6)
    inches = {n: Target(n, t.point_mm / 25.4, t.sigma_mm) for n, t in given.world_targets.items()}
    result = build_network(truth.nodes(), draw_pairs(truth), given=Given(inches, given.seen_targets))
    plain = build_network(truth.nodes(), draw_pairs(truth))
    assert result.network.frames == ()
    assert any("fixes no frame" in w and "point T" in w for w in result.network.warnings)
    assert unused(result.pairs) == set()
    for one, two in zip(plain.measurements, result.measurements, strict=True):
        np.testing.assert_array_equal(one.T_world_measurement, two.T_world_measurement)


def test_points_in_a_line_do_not_fix_a_frame_and_say_so():
    truth = panel(3, 2)
    every = known_points(truth)
    two = {name: list(targets)[:1] for name, targets in list(every.seen_targets.items())[:2]}
    given = Given(world_targets=every.world_targets, seen_targets=two)
    result = build_network(truth.nodes(), draw_pairs(truth), given=given)
    assert result.network.frames == ()
    assert any("do not fix the frame" in w for w in result.network.warnings)
    reference = next(m for m in result.measurements if m.name == result.groups[0].reference)
    np.testing.assert_array_equal(reference.T_world_measurement, np.eye(4))


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_that_is_wrong_by_20_mm_for_one_measurement_is_named_and_ignored(seed):
    truth = panel(4, 3, seed)
    bad = sorted(truth.T)[seed]
    given = Given(robot=robot(truth, seed=seed, wrong={bad: np.array([20.0, 0, 0])}))
    result = build_network(truth.nodes(), draw_pairs(truth, seed), given=given)
    plain = build_network(truth.nodes(), draw_pairs(truth, seed))
    tests = {test.measurement: test for test in result.network.given}
    assert [name for name, test in tests.items() if not test.used] == [bad]
    # The robot's own noise is a millimetre or two.
    assert tests[bad].residual_mm == pytest.approx(20, abs=5)
    assert unused(result.pairs) == set()
    for one, two in zip(plain.measurements, result.measurements, strict=True):
        # A robot good to a millimetre does not move what texture holds to hundredths.
        assert np.abs(one.T_world_measurement - two.T_world_measurement).max() < 0.02
    (frame,) = result.network.frames
    found = np.array(frame.T_world_frame) @ T_WORLD_OBJECT @ truth.T[result.groups[0].reference]
    # Eleven statements good to 1 mm and 2 mrad at arms of 600 mm.
    assert np.linalg.norm(found[:3, 3]) < 5


def test_an_honest_robot_is_left_out_no_more_often_than_stated():
    refused = 0
    for seed in range(40):
        truth = panel(3, 2, seed)
        result = build_network(truth.nodes(), draw_pairs(truth, seed), given=Given(robot=robot(truth, seed=seed)))
        refused += sum(not test.used for test in result.network.given)
    # By chance 1 in 1000 runs leaves one out.
    assert refused <= 1


def test_the_only_robot_statement_of_a_group_tests_nothing_and_changes_nothing():
    truth = panel(3, 1)
    name = sorted(truth.T)[0]
    given = Given(robot={name: robot(truth, wrong={name: np.array([50.0, 0, 0])})[name]})
    result = build_network(truth.nodes(), draw_pairs(truth), given=given)
    (test,) = result.network.given
    assert test.redundancy < 1e-6
    plain = build_network(truth.nodes(), draw_pairs(truth))
    for one, two in zip(plain.measurements, result.measurements, strict=True):
        np.testing.assert_allclose(one.T_world_measurement, two.T_world_measurement, atol=1e-9)


def test_a_pair_that_only_the_robot_checks_is_found_by_it():
    """A chain whose middle pair is wrong by 200 mm: no loop of pairs notices, the robot's statements do."""
    truth = panel(6, 1)
    order = sorted(truth.T, key=lambda n: truth.T[n][0, 3])
    middle = tuple(sorted((order[2], order[3])))
    pairs = draw_pairs(truth, 1, {middle: shift(200.0, 3)})
    assert unused(build_network(truth.nodes(), pairs).pairs) == set()
    result = build_network(truth.nodes(), pairs, given=Given(robot=robot(truth)))
    assert unused(result.pairs) == {middle}
    assert len(result.groups) == 2
    assert all(test.used for test in result.network.given)


def test_what_only_a_robot_checks_is_said_with_the_error_that_it_would_not_notice():
    truth = panel(3, 2)
    name = sorted(truth.T)[0]
    pairs = draw_pairs(truth)
    last = next(p for p in pairs if name in (p.a, p.b))
    pairs = [p for p in pairs if name not in (p.a, p.b) or p is last]
    result = build_network(truth.nodes(), pairs, given=Given(robot=robot(truth)))
    (sentence,) = [w for w in result.network.warnings if w.startswith(f"{name} hangs on one pair")]
    unseen = float(sentence.split("by less than ")[1].split(" mm")[0])
    # A robot good to 1 mm and 2 mrad at arms of 600 mm.
    assert 2 < unseen < 100


def curved(count=60):
    """A mesh of a bent and waved sheet, 600 x 400 mm, and its surface."""
    x, y = np.meshgrid(np.linspace(-300, 300, count), np.linspace(-200, 200, count))
    z = 60 * np.sin(x / 90) * np.cos(y / 70) + 0.0005 * x**2
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    k = np.arange(count * count).reshape(count, count)
    faces = np.concatenate([
        np.stack([k[:-1, :-1], k[:-1, 1:], k[1:, :-1]], -1).reshape(-1, 3),
        np.stack([k[1:, 1:], k[1:, :-1], k[:-1, 1:]], -1).reshape(-1, 3),
    ])  # fmt: skip
    return vertices, faces


def flat():
    vertices = np.array([[-600.0, -500, 0], [900, -500, 0], [-600, 900, 0], [900, 900, 0]])
    return vertices, np.array([[0, 1, 2], [3, 2, 1]])


def measured_on(vertices, faces, T_object_measurement, rng, noise=0.02, count=1500):
    """Points of a mesh, with noise along z, in the frame of a measurement."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    at = rng.choice(len(faces), count, p=area / area.sum())
    u, v = np.sort(rng.random((2, count)), axis=0)
    points = a[at] * u[:, None] + b[at] * (v - u)[:, None] + c[at] * (1 - v)[:, None]
    points[:, 2] += noise * rng.standard_normal(count)
    return transform_points(invert(T_object_measurement), points)


def one_measurement(mesh, seed=0):
    truth = panel(1, 1, seed)
    (name,) = truth.T
    points = measured_on(*mesh, truth.T[name], np.random.default_rng(seed))
    object.__setattr__(truth, "centroids", {name: points.mean(0)})
    return truth, name, {name: points}


def test_samples_of_a_mesh_lie_on_it_at_the_stated_distance():
    surface = sample_mesh(*flat(), most_points=2000)
    assert np.abs(surface.points[:, 2]).max() == 0
    np.testing.assert_allclose(np.abs(surface.normals[:, 2]), 1)
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-600, 900, 500), rng.uniform(-500, 900, 500), np.zeros(500)])
    assert surface.tree.query(places)[0].max() < surface.pitch_mm


def test_a_cloud_as_surface_has_the_normals_of_its_surface():
    vertices, _ = curved(80)
    surface = sample_cloud(vertices)
    x, y = vertices[:, 0], vertices[:, 1]
    slope = np.column_stack([
        -60 / 90 * np.cos(x / 90) * np.cos(y / 70) - 0.001 * x,
        60 / 70 * np.sin(x / 90) * np.sin(y / 70),
        np.ones(len(x)),
    ])  # fmt: skip
    inside = (np.abs(x) < 250) & (np.abs(y) < 160)
    cosine = np.abs(np.sum(surface.normals * slope, 1) / np.linalg.norm(slope, axis=1))[inside]
    assert cosine.min() > 0.99


def test_the_gradient_of_a_surface_is_that_of_its_cost():
    mesh = curved()
    surface = sample_mesh(*mesh)
    truth, name, points = one_measurement(mesh)
    T = perturb(truth.T[name], [1e-3, -2e-3, 1e-3, 0.3, -0.2, 0.1], np.zeros(3))
    for _ in range(8):
        relation = surface_relation(surface_hold(surface, points[name], T), name, T)
        T = relation.T_a_b
    # 1,500 points of 0.02 mm noise on facets of 10 mm.
    xi = difference(truth.T[name], T, transform_points(T, truth.centroids[name]))
    assert np.abs(xi[3:]).max() < 0.02
    assert relation.dof == 6


def test_a_measurement_is_placed_on_cad_from_a_robots_start():
    mesh = curved()
    truth, name, points = one_measurement(mesh)
    world_mesh = transform_points(T_WORLD_OBJECT, mesh[0]), mesh[1]
    given = Given(robot=robot(truth, sigma_mm=2.0), surface=sample_mesh(*world_mesh))
    result = build_network(truth.nodes(points), [], given=given)
    (placed,) = result.measurements
    xi = misplaced(truth, result.measurements, T_WORLD_OBJECT)[name]
    assert np.abs(xi[3:]).max() < 0.02
    frame = next(f for f in result.network.frames if f.kind == "given")
    assert frame.is_world
    assert frame.not_held == ()
    nees = xi @ np.linalg.solve(placed.covariance_noise, xi)
    # Tiles of 10 mm count as one: for independent noise that is pessimistic, never optimistic beyond chance.
    assert nees < 25


def test_a_group_on_cad_is_held_by_its_pairs_where_single_measurements_slide():
    """Six measurements of a sheet whose relief is at one end: pairs carry its hold to those on the flat."""
    truth = panel(3, 2, 4, overlap=0.3)
    x, y = np.meshgrid(np.linspace(-250, 850, 111), np.linspace(-250, 500, 76))
    z = 40 * np.sin(x / 60) * np.cos(y / 70) * (x < 120)
    k = np.arange(x.size).reshape(x.shape)
    faces = np.concatenate([
        np.stack([k[:-1, :-1], k[:-1, 1:], k[1:, :-1]], -1).reshape(-1, 3),
        np.stack([k[1:, 1:], k[1:, :-1], k[:-1, 1:]], -1).reshape(-1, 3),
    ])  # fmt: skip
    mesh = np.stack([x, y, z], -1).reshape(-1, 3), faces
    rng, points = np.random.default_rng(4), {}
    for name in sorted(truth.T):
        every = measured_on(*mesh, np.eye(4), rng, count=40_000)
        middle = transform_points(truth.T[name], truth.centroids[name])
        near = (np.abs(every[:, :2] - middle[:2]) < [200, 150]).all(1)
        points[name] = transform_points(invert(truth.T[name]), every[near])
    surface = sample_mesh(transform_points(T_WORLD_OBJECT, mesh[0]), faces)
    given = Given(robot=robot(truth, sigma_mm=2.0), surface=surface)
    pairs = draw_pairs(truth, 4)
    result = build_network(truth.nodes(points), pairs, given=given)
    frame = next(f for f in result.network.frames if f.kind == "given")
    assert (frame.is_world, frame.not_held) == (True, ())
    assert unused(result.pairs) == set()
    xi = misplaced(truth, result.measurements, T_WORLD_OBJECT)
    assert max(np.linalg.norm(x[3:]) for x in xi.values()) < 0.05
    flat_one = max(truth.T, key=lambda n: truth.T[n][0, 3])
    alone = build_network([n for n in truth.nodes(points) if n.name == flat_one], [], given=given)
    assert next(f for f in alone.network.frames if f.kind == "given").not_held


def test_a_flat_surface_says_which_directions_it_does_not_hold():
    mesh = flat()
    truth, _name, points = one_measurement(mesh)
    world_mesh = transform_points(T_WORLD_OBJECT, mesh[0]), mesh[1]
    given = Given(robot=robot(truth, sigma_mm=2.0), surface=sample_mesh(*world_mesh))
    result = build_network(truth.nodes(points), [], given=given)
    frame = next(f for f in result.network.frames if f.kind == "given")
    assert sum("shift along" in text for text in frame.not_held) == 2
    assert sum("rotation about" in text for text in frame.not_held) == 1
    (placed,) = result.measurements
    normal = T_WORLD_OBJECT[:3, :3] @ np.array([0.0, 0, 1])
    C = placed.covariance_noise[3:, 3:]
    assert np.sqrt(normal @ C @ normal) < 0.1
    # What nothing holds is uncertain by a metre: nobody can take it for known.
    assert np.sqrt(np.linalg.eigvalsh(C)[-1]) > 100
    assert any("not held" in w for w in result.network.warnings)


def test_a_surface_ties_no_measurement_that_has_no_start():
    truth, _, points = one_measurement(curved())
    result = build_network(truth.nodes(points), [], given=Given(surface=sample_mesh(*curved())))
    assert result.network.frames == ()
    assert any("nothing says where it lies" in w for w in result.network.warnings)


def test_directions_are_held_where_the_surface_has_relief():
    for mesh, count in ((curved(), 6), (flat(), 3)):
        truth, name, points = one_measurement(mesh)
        hold = surface_hold(sample_mesh(*mesh), points[name], truth.T[name])
        assert held_directions(hold)[2].sum() == count


def test_a_measurement_far_from_the_surface_is_not_on_it():
    far = compose(exp_so3([0, 0, 0]), [0, 0, 0])
    points = np.random.default_rng(0).uniform(-100, 100, (500, 3)) + np.array([5000.0, 0, 0])
    assert surface_hold(sample_mesh(*flat()), points, far) is None
