"""What errors of the rig do to a pair: against refining again with both measurements really displaced."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import sheets
from calibrated_rig import with_calibration
from planish.geometry import compose, difference, exp_so3, perturb
from planish.pipeline import register
from planish.registration.pair import pair_shifts, refine_pair
from planish.registration.prepared import Prepared, RefinementMaps
from planish.registration.refine.calibration import calibration_covariance
from planish.registration.refine.covariance import noise_covariance
from planish.registration.refine.residuals import Weights, equations, pull
from planish.registration.refine.sides import joint_sides
from planish.registration.result import Registration
from planish.registration.rig_errors import displacements, rig_key
from planish.registration.surface import fit_surface
from planish.registration.texture.photometric import local_contrast
from planish.rig import Rig
from reference import joint as reference

#: Corners in these coarse pixels as certain in millimetres as 0.05 px of the reference sensor.
CORNER_PX = 0.05 * sheets.SCALE
#: First order, 300 tiles and every second pixel: what is left of a shift, of its size and of the pair's noise.
SHARE, NOISE_SHARE = 0.05, 0.25
#: Central differences of the twin, float32 look-ups; relative to the largest element.
PULL_TOLERANCE = 0.01
SETTINGS = {"max_distance_mm": 3.0, "max_normal_rad": 0.35, "threads": 2}


@cache
def rig():
    """The sheets' camera and a second one beside it that looks at the same place, with a calibration's covariance."""
    a = sheets.quiet("a").camera
    turn = compose(exp_so3([0, 0.3, 0.02]), [0, 0, 0])
    aside = compose(np.eye(3), [-250.0, 10, 0]) @ turn @ a.T_camera_sensor
    return with_calibration(Rig({"A": a, "B": replace(a, T_camera_sensor=aside)}), corner_px=CORNER_PX)


@cache
def measured(side, bend):
    m = sheets.noisy(sheets.quiet(side, bend), 1 + "ab".index(side))
    item = rig()
    return replace(m, rig=item, correspondence_px=item.cameras["B"].project(m.points_sensor).astype(np.float32))


def displaced(m, error):
    """The measurement as a rig with an error (k,), in standard deviations of its modes, gives it."""
    v, u = np.indices(m.shape)
    moved = np.tensordot(error, displacements(m, np.stack([u.ravel(), v.ravel()], -1)), 1).reshape(*m.shape, 3)
    return replace(
        m, rig=m.rig.changed(error @ m.rig.modes()), points_sensor=m.points_sensor + moved.astype(np.float32)
    )


def prepared(m):
    """What the refinement needs of a measurement, without its keypoints."""
    surface, contrast = fit_surface(m), local_contrast(m)
    options = sheets.OPTIONS
    sides = joint_sides(m, surface, contrast, options.refine.spacing_px, options.photometric.shading_mm)
    maps = RefinementMaps(lambda: (sides, sides))
    return Prepared(m, surface, contrast, (), (), None, maps, sheets.OPTIONS.dense)


@pytest.mark.parametrize("bend", [0.0, sheets.BENT])
def test_transforms_change_as_they_do_when_both_measurements_are_displaced(bend):
    a, b = (measured(side, bend) for side in "ab")
    sides = prepared(a), prepared(b)
    found = refine_pair(*sides, sheets.T_TRUE, sheets.OPTIONS, 2)
    (shifts,) = pair_shifts(*sides, found, sheets.OPTIONS, 2).values()
    assert shifts.shape == (len(rig().modes()), 6)
    whiten = np.linalg.inv(np.linalg.cholesky(noise_covariance(found)))
    for seed in range(2):
        error = np.random.default_rng(seed).standard_normal(len(shifts))
        ends = []
        for sign in (1, -1):
            moved = (prepared(displaced(m, sign * error)) for m in (a, b))
            again = refine_pair(*moved, found.T_a_b, sheets.OPTIONS, 2)
            ends.append(difference(again.T_a_b, found.T_a_b, found.about))
        xi = (ends[0] - ends[1]) / 2
        left, size = (np.linalg.norm(whiten @ x) for x in (xi - error @ shifts, xi))
        assert size > 5
        assert left <= SHARE * size + NOISE_SHARE


def test_errors_that_move_the_frame_alone_move_the_transform_with_it():
    """A rig whose parts all turn together measures in a turned frame: T_a_b becomes E T_a_b E^-1."""
    a, b = (measured(side, sheets.BENT) for side in "ab")
    sides = prepared(a), prepared(b)
    found = refine_pair(*sides, sheets.T_TRUE, sheets.OPTIONS, 2)
    xi = np.array([2e-4, -1e-4, 3e-4, 0.05, 0.1, -0.02])
    E = perturb(np.eye(4), xi, np.zeros(3))
    names = [f"{d}.{n}_{axis}" for d in "AB" for n in ("rotation", "translation") for axis in "xyz"]
    # Exp(x) T = T E^-1, device by device.
    change = np.concatenate(
        [
            difference(c.T_camera_sensor @ np.linalg.inv(E), c.T_camera_sensor, np.zeros(3))
            for c in rig().cameras.values()
        ]
    )
    stated = replace(rig(), covariance=np.outer(change, change), covariance_parameters=tuple(names))
    sides = [replace(s, measurement=replace(s.measurement, rig=stated)) for s in sides]
    (shifts,) = pair_shifts(*sides, found, sheets.OPTIONS, 2).values()
    expected = difference(E @ found.T_a_b @ np.linalg.inv(E), found.T_a_b, found.about)
    sign = np.sign(shifts[0] @ expected)
    scale = np.array([100.0] * 3 + [1.0] * 3)
    np.testing.assert_allclose(sign * scale * shifts[0], scale * expected, atol=2e-3 * np.abs(scale * expected).max())


def test_rigs_of_their_own_have_errors_of_their_own():
    a, b = measured("a", 0.0), measured("b", 0.0)
    other = replace(b, rig=replace(b.rig, covariance=b.rig.covariance * (1 + 1e-9)))
    found = refine_pair(prepared(a), prepared(b), sheets.T_TRUE, sheets.OPTIONS, 2)
    (common,) = pair_shifts(prepared(a), prepared(b), found, sheets.OPTIONS, 2).values()
    apart = pair_shifts(prepared(a), prepared(other), found, sheets.OPTIONS, 2)
    assert set(apart) == {rig_key(a.rig), rig_key(other.rig)}
    np.testing.assert_allclose(sum(apart.values()), common, atol=1e-6 * np.abs(common).max())
    expected = sum(x.T @ x for x in apart.values())
    np.testing.assert_allclose(calibration_covariance(apart), expected, rtol=1e-12)
    assert not np.allclose(expected, calibration_covariance({"one": common}), rtol=0.1)


def test_a_pair_of_which_one_rig_states_no_errors_states_none():
    a, b = measured("a", 0.0), sheets.noisy(sheets.quiet("b", 0.0), 2)
    result = register([a, b], threads=2)
    assert [p.status for p in result.pairs] == ["accepted"]
    assert result.pairs[0].covariance_calibration is None
    assert all(m.covariance_calibration is None for m in result.measurements)


def test_a_registration_states_both_covariances_and_keeps_them(tmp_path):
    a, b = measured("a", sheets.BENT), measured("b", sheets.BENT)
    result = register([a, b], threads=2)
    (pair,) = result.pairs
    (shifts,) = pair.calibration_shifts.values()
    np.testing.assert_allclose(pair.covariance_calibration, shifts.T @ shifts)
    assert np.linalg.eigvalsh(pair.covariance_calibration).min() > 0
    moved = [m for m in result.measurements if np.any(m.covariance_calibration)]
    assert len(moved) == 1
    result.save(tmp_path / "registration.json")
    assert "calibration_shifts" not in json.dumps(result.to_json())
    again = Registration.load(tmp_path / "registration.json")
    np.testing.assert_array_equal(again.pairs[0].covariance_calibration, pair.covariance_calibration)
    one = register([a, b], threads=1)
    np.testing.assert_array_equal(one.pairs[0].covariance_calibration, pair.covariance_calibration)


def tiles(bend):
    a, b = (prepared(measured(side, bend)) for side in "ab")
    about = np.array([30.0, 10.0, -5.0])
    T = perturb(sheets.T_TRUE, [1e-4, 2e-4, -1e-4, 0.1, 0.05, 0.02], about)
    # Far from the rim of either image, so that a small motion leaves every pixel in.
    inner = np.zeros(b.measurement.shape, np.uint8)
    inner[40:-40, 80:-100] = 1
    return a.sides[1], replace(b.sides[1], use=inner), a.measurement.camera, T, about


#: Robust scale of residuals over their noise, near to what it is.
SCALE = 1.2


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.0, 0.8)], ids=["d", "t"])
def test_the_pull_of_a_tile_is_the_derivative_of_its_gradient(weights):
    a, b, camera, T, about = tiles(sheets.BENT)
    found = pull(a, b, T, about, Weights.alike(b, 16, *weights, SCALE), stride=1, tile_px=16, **SETTINGS)
    both = [(SCALE, w) for w in weights]
    expected = reference.tile_pulls(a.maps, camera, b.maps, T, about, both, 3.0, np.cos(0.35), 16)
    u, v = found.pixels.T
    assert len(found.pixels) == np.isfinite(expected).all((2, 3)).sum()
    scale = np.array([150.0] * 3 + [1.0] * 3)[None, :, None]
    one, two = (found.distance + found.texture) / scale, expected[v // 16, u // 16] / scale
    np.testing.assert_allclose(one, two, atol=PULL_TOLERANCE * np.abs(two).max())


def test_the_pull_of_all_tiles_changes_the_gradient_as_a_step_of_the_transform_does():
    a, b, _, T, about = tiles(sheets.BENT)
    weights = Weights.alike(b, 16, 1.0, 0.8, SCALE)
    found = pull(a, b, T, about, weights, stride=1, tile_px=16, **SETTINGS)
    total = (found.distance + found.texture).sum(0)
    for axis in range(3):
        xi = np.zeros(6)
        xi[3 + axis] = 2e-3
        ends = [
            equations(
                a, b, perturb(T, s * xi, about), about, weights, stride=1, tile_px=16, residuals=False, **SETTINGS
            )
            for s in (1, -1)
        ]
        g = [e.g_distance + e.g_texture for e in ends]
        scale = np.array([150.0] * 3 + [1.0] * 3)
        expected = (g[0] - g[1]) / 4e-3 / scale
        np.testing.assert_allclose(total[:, axis] / scale, expected, atol=PULL_TOLERANCE * np.abs(expected).max())
