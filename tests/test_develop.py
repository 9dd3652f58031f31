"""Unrolling: exact where a surface is developable, little stretch elsewhere, pieces that do not hang together apart."""

from __future__ import annotations

import numpy as np
import pytest

import sheets
from planish.geometry import exp_se3, transform_points
from planish.registration.surface import Surface, fit_surface
from planish.registration.texture.charts import ChartOptions, plan_charts
from planish.registration.texture.develop import surface_nodes, unroll

#: Points and normals are float32: 6e-5 mm at 1000 mm, added up over some fifty edges.
EXACT_MM = 2e-3
HINT = np.array([1.0, 0, 0])
#: Where the sensor stood: developing must not depend on it.
T_SENSOR_OBJECT = exp_se3([0.3, -0.2, 0.5, 20, -10, 900])


def sheet(points, normals):
    """Surface of an object's points and outward normals, as a sensor would give it."""
    seen = transform_points(T_SENSOR_OBJECT, points).astype(np.float32)
    turned = (normals @ T_SENSOR_OBJECT[:3, :3].T).astype(np.float32)
    return Surface(seen, turned, np.zeros((*points.shape[:2], 6), np.float32))


def grid(rows=60, columns=80):
    """Angles within 70 degrees of the middle, and lengths [mm]."""
    return np.meshgrid(np.linspace(-1.2, 1.2, columns), np.linspace(0, 300, rows))


def cylinder(radius=150.0):
    angle, y = grid()
    normals = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], -1)
    return sheet(radius * normals + y[..., None] * np.array([0, 1, 0]), normals), radius * angle, y


def fitted_error(coordinates, expected):
    """Largest distance [mm] after the best motion in the plane."""
    a, b = coordinates - coordinates.mean(0), expected - expected.mean(0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    assert np.linalg.det(U @ Vt) > 0, "mirrored"
    return np.abs(a @ U @ Vt - b).max()


@pytest.mark.parametrize("step", [2, 5])
def test_a_pipe_is_unrolled_into_its_arcs(step):
    surface, s, t = cylinder()
    nodes = surface_nodes(surface, step)
    coordinates, axes, strain = unroll(nodes, HINT)
    first = step // 2
    expected = np.column_stack([m[first::step, first::step].ravel()[nodes.index] for m in (s, t)])
    assert fitted_error(coordinates, expected) < EXACT_MM
    assert np.abs(strain).max() < 1e-4
    np.testing.assert_allclose(np.einsum("nij,nkj->nik", axes, axes), np.tile(np.eye(2), (len(axes), 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.cross(axes[:, 0], axes[:, 1]), -nodes.normals, atol=1e-6)


def test_a_cone_keeps_its_lengths_too():
    angle, slant = grid()
    slant, opening = 400 + slant, 0.4
    radius, along = slant * np.sin(opening), slant * np.cos(opening)
    points = np.stack([radius * np.sin(angle), along, -radius * np.cos(angle)], -1)
    cosine, sine = np.cos(opening), np.sin(opening)
    normals = np.stack([cosine * np.sin(angle), -sine + 0 * angle, -cosine * np.cos(angle)], -1)
    nodes = surface_nodes(sheet(points, normals), 3)
    coordinates, _, strain = unroll(nodes, HINT)
    turned = angle * sine
    fan = np.stack([slant * np.sin(turned), slant * np.cos(turned)], -1)[1::3, 1::3].reshape(-1, 2)[nodes.index]
    # Arcs between nodes 15 mm apart are taken for those of circles: a ten-thousandth of the fan's size.
    assert fitted_error(coordinates, fan) < 0.05
    assert np.abs(strain).max() < 1e-3


def ball(radius=200.0):
    angle, tilt = np.meshgrid(np.linspace(-0.9, 0.9, 80), np.linspace(-0.9, 0.9, 60))
    normals = np.stack([np.sin(angle) * np.cos(tilt), np.sin(tilt), -np.cos(angle) * np.cos(tilt)], -1)
    return sheet(radius * normals, normals)


def test_a_ball_is_stretched_evenly_and_little():
    _, _, strain = unroll(surface_nodes(ball(), 2), HINT)
    # Seen orthographically, its rim (62 degrees) would shrink to less than half.
    assert np.percentile(np.abs(strain), 95) < 0.2
    assert abs(np.median(strain)) < 0.05


def test_what_cannot_be_unrolled_is_split_into_parts_that_can_and_overlap():
    m = sheets.quiet("a")
    options = ChartOptions(max_strain=0.05)
    assert len(plan_charts(m, cylinder()[0])) == 1
    charts = plan_charts(m, ball(), options)
    assert 3 <= len(charts) <= options.max_charts
    assert all(chart.strain < 1.5 * options.max_strain for chart in charts)
    held = np.sum([chart.maps[..., 0] > 0 for chart in charts], 0)
    assert (held > 0).mean() > 1 - options.uncovered
    assert (held > 1).mean() > 0.1


def test_a_hole_does_not_split_a_surface_but_a_step_does():
    surface, *_ = cylinder()
    holed = surface.points_sensor.copy()
    holed[20:40, 20:50] = np.nan
    pieces = surface_nodes(Surface(holed, surface.normals_sensor, surface.tangents_sensor), 3).pieces(3)
    assert len(pieces) == 1
    _, _, strain = unroll(pieces[0], HINT)
    assert np.abs(strain).max() < 1e-4
    stepped = surface.points_sensor - 25 * surface.normals_sensor * (np.arange(80) > 50)[None, :, None]
    assert len(surface_nodes(Surface(stepped, surface.normals_sensor, surface.tangents_sensor), 3).pieces(3)) == 2


def test_a_plate_a_bent_sheet_and_nothing_need_one_one_and_no_chart():
    for bend in (0.0, sheets.BENT):
        m = sheets.quiet("a", bend)
        charts = plan_charts(m, fit_surface(m))
        assert len(charts) == 1
        assert charts[0].strain < 0.02
    surface = fit_surface(m)
    nothing = Surface(*(np.full_like(getattr(surface, n), np.nan) for n in surface.__dataclass_fields__))
    assert plan_charts(m, nothing) == ()
