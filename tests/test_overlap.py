"""The overlap of two registered measurements: geometry, signs, shifts along the surface."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import synthetic
from planish import _core
from planish.errors import InputError
from planish.evaluation.overlap import OverlapOptions, evaluate_overlap, signed_distances
from planish.evaluation.prepared import Prepared
from planish.evaluation.tangential import measure_tile_shifts
from planish.geometry import invert, perturb, transform_points
from reference import overlap as reference

SCALE, BEND, SIGMA_MM = 0.35, 1 / 800, 0.03
#: float32 points of 1 m resolve 6e-5 mm; the twin works in float64.
DISTANCE_TOLERANCE_MM = 2e-4
#: Overlaps are sums over pixels: half a pixel along the rim of images of 278 x 208 px is one part in a hundred.
OVERLAP_TOLERANCE = 0.015

T_TRUE = perturb(np.eye(4), [0.02, -0.03, 0.3, 60, 25, 5], [0, 0, 0])


@pytest.fixture(scope="module")
def sheet():
    return synthetic.raster(1, 0.03)


@pytest.fixture(scope="module")
def bent(sheet):
    """Two measurements of a bent sheet, T_a_b = T_TRUE."""
    a = synthetic.measurement(np.eye(4), sheet, name="a", scale=SCALE, bend=BEND, sigma_mm=SIGMA_MM, seed=1)
    b = synthetic.measurement(T_TRUE, sheet, name="b", scale=SCALE, bend=BEND, sigma_mm=SIGMA_MM, seed=2)
    return Prepared(a), Prepared(b)


@pytest.fixture(scope="module")
def flat(sheet):
    """Two measurements of a flat sheet without depth noise."""
    a = synthetic.measurement(np.eye(4), sheet, name="a", scale=0.2, sigma_mm=0.0, seed=1)
    b = synthetic.measurement(T_TRUE, sheet, name="b", scale=0.2, sigma_mm=0.0, seed=2)
    return Prepared(a), Prepared(b)


def footprint(item, T_object_sensor):
    """Outline (N, 2) of the measured area on the flat sheet: pixel centres of the image's rim."""
    points = transform_points(T_object_sensor, item.measurement.points_sensor.astype(float))[..., :2]
    return np.concatenate([points[0], points[:, -1], points[-1, ::-1], points[::-1, 0]]).astype(np.float32)


def test_the_overlap_is_the_shared_area_over_the_smaller_one(flat):
    a, b = flat
    outlines = footprint(a, np.eye(4)), footprint(b, T_TRUE)
    shared, _ = cv2.intersectConvexConvex(*(cv2.convexHull(o) for o in outlines))
    expected = shared / min(cv2.contourArea(o) for o in outlines)
    assert 0.5 < expected < 0.9
    assert evaluate_overlap(a, b, T_TRUE).overlap == pytest.approx(expected, abs=OVERLAP_TOLERANCE)


def test_a_measurement_overlaps_itself_wholly_and_without_error(bent):
    found = evaluate_overlap(bent[0], bent[0], np.eye(4))
    assert found.overlap > 0.99
    assert np.nanmax(np.abs(found.distance_mm)) < DISTANCE_TOLERANCE_MM
    assert found.error.rms_tangential_mm < 1e-3


def test_the_distance_is_positive_where_b_is_nearer_to_the_sensor(flat):
    a, b = flat
    towards_sensor = np.nanmean(a.surface.normals_sensor, (0, 1))
    lifted = perturb(T_TRUE, [0, 0, 0, *(0.2 * towards_sensor)], [0, 0, 0])
    found = evaluate_overlap(a, b, lifted)
    assert found.error.min_mm == pytest.approx(0.2, abs=1e-3)
    assert found.error.max_mm == pytest.approx(0.2, abs=1e-3)
    assert found.error.rms_normal_mm == pytest.approx(0.2, abs=1e-3)
    assert np.nanmean(found.distance_of_a_mm) == pytest.approx(-0.2, abs=1e-3)


def test_surfaces_farther_apart_than_a_millimetre_do_not_overlap(flat):
    a, b = flat
    lifted = perturb(T_TRUE, [0, 0, 0, 0, 0, 1.2], [0, 0, 0])
    found = evaluate_overlap(a, b, lifted)
    assert found.overlap == 0
    assert found.error is None
    assert evaluate_overlap(a, b, lifted, OverlapOptions(max_distance_mm=1.5)).overlap > 0.5


def test_surfaces_that_face_opposite_ways_do_not_overlap(flat):
    a, b = flat
    turned = Prepared(b.measurement, replace(b.surface, normals_sensor=-b.surface.normals_sensor))
    assert evaluate_overlap(a, turned, T_TRUE).error is None


def test_distances_show_the_noise_of_both_measurements(bent):
    error = evaluate_overlap(*bent, T_TRUE).error
    # The look-up averages a's noise over four pixels: 4/9 of its variance is left on average, at 17 degrees incidence.
    expected = SIGMA_MM * np.sqrt(1 + 4 / 9) * np.cos(0.3)
    assert error.rms_normal_mm == pytest.approx(expected, rel=0.1)
    assert error.points > 50_000
    assert -0.1 < error.min_mm < -0.01 < 0.01 < error.max_mm < 0.1


def test_order_of_the_pair_changes_only_signs(bent):
    a, b = bent
    forward, backward = evaluate_overlap(a, b, T_TRUE), evaluate_overlap(b, a, invert(T_TRUE))
    assert forward.overlap == pytest.approx(backward.overlap, abs=OVERLAP_TOLERANCE)
    assert forward.error.rms_normal_mm == pytest.approx(backward.error.rms_normal_mm, rel=0.05)
    assert np.array_equal(forward.distance_of_a_mm, backward.distance_mm, equal_nan=True)


@pytest.mark.parametrize("shift", [(0.1, 0.0), (0.0, 0.05), (0.7, -0.5)])
def test_a_shift_along_the_surface_is_found_within_its_sigma(bent, shift):
    a, b = bent
    tiles = evaluate_overlap(a, b, perturb(T_TRUE, [0, 0, 0, *shift, 0], [0, 0, 0])).tiles
    information = np.linalg.inv(tiles.covariances)
    normal = np.einsum("kia,kij,kjb->ab", tiles.axes_a, information, tiles.axes_a)
    right = np.einsum("kia,kij,kj->a", tiles.axes_a, information, tiles.shifts_mm)
    # The sheet is seen from z: x and y lie in it to first order.
    found = np.linalg.solve(normal[:2, :2], right[:2])
    sigma = np.sqrt(np.diag(np.linalg.inv(normal[:2, :2])))
    assert (sigma < 0.01).all()
    # The tangent planes tilt against x, y by up to 0.15: that costs one in a hundred of the shift.
    assert np.abs(found - shift).max() < 4 * sigma.max() + 0.012 * np.linalg.norm(shift)


def test_the_stated_noise_explains_the_shifts_of_a_right_transform(bent):
    error, tiles = (lambda e: (e.error, e.tiles))(evaluate_overlap(*bent, T_TRUE))
    assert len(tiles.tiles) > 100
    assert error.rms_tangential_mm == pytest.approx(error.sigma_tangential_mm, rel=0.3)
    chi2 = np.einsum("ki,kij,kj->k", tiles.shifts_mm, np.linalg.inv(tiles.covariances), tiles.shifts_mm)
    assert 0.6 < chi2.mean() / 2 < 1.4


def test_a_gap_along_the_normal_is_no_shift_along_the_surface(bent):
    a, b = bent
    error = evaluate_overlap(a, b, perturb(T_TRUE, [0, 0, 0, 0, 0, 0.3], [0, 0, 0])).error
    assert error.rms_normal_mm == pytest.approx(0.3, rel=0.1)
    # On the bent sheet 0.3 mm along z have a part of up to 0.3 x 0.15 along the surface.
    assert error.rms_tangential_mm < 2 * error.sigma_tangential_mm


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_without_texture_there_is_no_error_along_the_surface(sheet, seed):
    a, b = (
        synthetic.measurement(T, np.ones_like(sheet), name=n, scale=0.2, seed=i)
        for i, (n, T) in enumerate([("a", np.eye(4)), ("b", T_TRUE)], seed)
    )
    error = evaluate_overlap(a, b, T_TRUE).error
    assert error.points > 10_000
    assert error.rms_tangential_mm is None
    assert error.sigma_tangential_mm is None


def test_the_result_is_the_same_for_any_number_of_threads(bent):
    results = [evaluate_overlap(*bent, T_TRUE, threads=n) for n in (1, 2, 5)]
    for other in results[1:]:
        assert other.error == results[0].error
        assert other.distance_mm.tobytes() == results[0].distance_mm.tobytes()
        assert other.tiles.shifts_mm.tobytes() == results[0].tiles.shifts_mm.tobytes()


def test_a_transform_that_is_not_rigid_is_refused(bent):
    with pytest.raises(InputError, match="T_a_b"):
        evaluate_overlap(*bent, 2 * np.eye(4))


def test_distances_equal_those_of_the_twin(flat):
    a, b = flat
    tilted = perturb(T_TRUE, [0.002, -0.001, 0, 0, 0, 0.1], [0, 0, 0])
    found, _ = signed_distances(a, b, tilted)
    expected = reference.look_up_distance(
        a.measurement.points_sensor, a.surface.normals_sensor, a.measurement.camera,
        b.measurement.points_sensor, b.surface.normals_sensor, tilted, 1.0,
    )  # fmt: skip
    both = np.isfinite(found) & np.isfinite(expected)
    # Points that fall on the rim within rounding may count in one and not in the other.
    assert (np.isfinite(found) != np.isfinite(expected)).mean() < 1e-4
    assert both.mean() > 0.3
    assert np.abs(found - expected)[both].max() < DISTANCE_TOLERANCE_MM


def test_medians_of_cells_equal_those_of_the_twin():
    rng = np.random.default_rng(4)
    # Rounded, so that some are equal.
    values = rng.standard_normal((53, 41)).round(1).astype(np.float32)
    values[rng.random(values.shape) < 0.4] = np.nan
    for size, least in ((6, 18), (5, 1), (60, 3)):
        expected = reference.cell_medians(values, size, least)
        assert np.allclose(_core.cell_medians(values, size, least, 2), expected, equal_nan=True, atol=1e-6)


def test_areas_of_pixels_are_those_of_the_twin(bent):
    tangents = bent[0].surface.tangents_sensor.copy()
    tangents[3:5] = np.nan
    found, expected = _core.pixel_areas(tangents, 2), reference.pixel_areas(tangents.astype(float))
    assert np.allclose(found, expected, rtol=1e-5, atol=0)
    assert not found[3:5].any()


def test_sums_of_known_distances_are_those_of_the_twin_for_any_number_of_threads(bent):
    areas, rng = bent[0].areas_mm2, np.random.default_rng(4)
    distances = rng.normal(0, 0.1, areas.shape).astype(np.float32)
    distances[rng.random(areas.shape) < 0.3] = np.nan
    found = _core.known_distances(distances, areas, 1)
    assert np.allclose(found, reference.known_distances(distances, areas), rtol=1e-9)
    assert found == _core.known_distances(distances, areas, 3)
    with pytest.raises(ValueError, match="differ in size"):
        _core.known_distances(distances, areas[1:], 1)


def test_what_lies_behind_or_beside_the_camera_has_no_distance(bent):
    a, b = bent
    for turn in (np.diag([-1.0, 1, -1, 1]), np.diag([1.0, -1, -1, 1])):
        assert np.isnan(signed_distances(a, b, turn @ T_TRUE)[0]).all()
    beside = perturb(T_TRUE, [0, 0, 0, 5e3, 0, 0], [0, 0, 0])
    assert np.isnan(signed_distances(a, b, beside)[0]).all()


def test_tile_shifts_solve_the_equations_of_the_twin(bent, monkeypatch):
    a, b = bent
    calls = []
    kernel = _core.tile_shifts
    monkeypatch.setattr(_core, "tile_shifts", lambda *args: calls.append(args) or kernel(*args))
    distance, pixels = signed_distances(b, a, invert(T_TRUE), with_pixels=True)
    measure_tile_shifts(a, b, T_TRUE, distance, pixels)
    value_a, sigma_a, value_b, sigma_b, pixels_b, rows, size = calls[0][:7]
    shifts = kernel(*calls[0])[:, :2]
    for k in (0, len(rows) // 2, len(rows) - 1):
        rest, curvature = reference.tile_residual(
            value_a, value_b, sigma_a, sigma_b, pixels_b, rows[k], size, shifts[k]
        )
        # The kernel stops at a last step of a thousandth of a pixel.
        assert np.linalg.norm(np.linalg.solve(curvature, rest)) < 2e-3 * a.gsd_mm
