"""Which pixels of one measurement's image the points of another one fall on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import sheets
from planish.geometry import perturb
from planish.registration.seen import nearest_pixels
from reference import locate as reference

STRIDE = 3
#: Of a point [mm]: float64 sums in another order.
POINT_TOLERANCE_MM = 1e-9
FAR_MM = 1e5


def test_points_fall_where_the_twin_finds_them():
    a, b = (p.measurement for p in sheets.pair())
    points = b.points_sensor.copy()
    points[::6, ::9] = np.nan
    T = perturb(sheets.T_TRUE, [0.1, 0, 0.2, 30, 0, 0], [0, 0, 0])
    found = nearest_pixels(a, replace(b, points_sensor=points), T, STRIDE)
    expected = reference.nearest_pixels(points, STRIDE, a.camera, a.shape, T)
    # Some points are unknown, some are out of sight.
    assert 100 < len(expected[0]) < 0.95 * points[::STRIDE, ::STRIDE, 0].size
    for mine, wanted in zip(found[:2], expected[:2], strict=True):
        np.testing.assert_array_equal(mine, wanted)
    np.testing.assert_allclose(found[2], expected[2], atol=POINT_TOLERANCE_MM)


def test_what_lies_behind_the_camera_is_not_seen():
    a, b = (p.measurement for p in sheets.pair())
    T = np.eye(4)
    # So far behind that they would fall into the middle of the image.
    T[:3, 3] = -FAR_MM * a.camera.T_camera_sensor[2, :3]
    assert len(nearest_pixels(a, b, T, 1)[0]) == 0
