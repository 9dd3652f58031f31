"""The synthetic observations that calibration is judged by, against the renderer's own geometry."""

from dataclasses import replace

import numpy as np
import pytest

from planish.errors import InputError
from planish.geometry import exp_se3, transform_points
from planish.sensing.capture.board import parse_board
from planish.simulation.board_places import board_places, see_board
from planish.simulation.boards import PrintedBoard
from planish.simulation.rigs import draw_rig, with_expected_covariance
from planish.simulation.sensor import reference_rig
from seen_boards import observations

RIG = reference_rig()
BOARD = PrintedBoard(
    parse_board({"schema": "planish.board/1", "kind": "chessboard", "corners": [9, 6], "pitch_mm": 25}, "board"),
    sagitta_mm=2.0,
)
PLACES = board_places(RIG, BOARD, 4, seed=1)
#: Second order of a step of half a pixel, and of the curvature of the sheet over it [projector px].
SECOND_ORDER_PX = 1e-3
#: Central differences, amplified by the inversion.
DIFFERENCES = 1e-3


def test_without_noise_all_devices_see_the_true_points():
    found = observations(RIG, BOARD, PLACES, noise_px=0.0)
    assert found.devices == ("A", "B", "projector")
    assert [view.name for view in found.views] == ["01", "02", "03", "04"]
    for view, T in zip(found.views, PLACES, strict=True):
        seen = see_board(RIG, BOARD, T)
        for camera, points in view.cameras.items():
            assert np.array_equal(points.index, np.flatnonzero(seen[camera].inside))
            assert np.array_equal(points.pixel_px, seen[camera].pixel_px[points.index])
        for code in view.code:
            assert np.allclose(code.position_px, seen["projector"].pixel_px[code.index], atol=1e-9)


@pytest.mark.parametrize("camera", ["A", "B"])
def test_the_code_moves_over_the_board_as_rays_that_meet_it_do(camera):
    found = observations(RIG, BOARD, PLACES, noise_px=0.0)
    for view, T in zip(found.views, PLACES, strict=True):
        code = next(item for item in view.code if item.camera == camera)
        T_sensor_object = T @ np.linalg.inv(BOARD.T_object_board)
        eye = transform_points(np.linalg.inv(T_sensor_object), RIG.cameras[camera].center_sensor[None])
        for step in ([0.5, 0.0], [0.0, -0.5]):
            rays = RIG.cameras[camera].rays_sensor(code.camera_px + step) @ T_sensor_object[:3, :3]
            hits, _, _ = BOARD.surface.intersect(np.broadcast_to(eye, rays.shape), rays)
            met = RIG.projector.project(transform_points(T_sensor_object, hits))
            predicted = code.position_px + code.jacobian @ step
            on_sheet = np.isfinite(met[:, 0])
            assert on_sheet.mean() > 0.9
            assert np.abs(met - predicted)[on_sheet].max() < SECOND_ORDER_PX


def test_noise_has_the_size_that_is_stated():
    places = PLACES * 6
    exact, noisy = (observations(RIG, BOARD, places, noise, code_noise_px=2 * noise, spread=0.3) for noise in (0, 0.05))
    pairs = [(a, b) for a, b in zip(exact.views, noisy.views, strict=True)]
    corners = np.concatenate(
        [
            (b.cameras[n].pixel_px - a.cameras[n].pixel_px) / b.cameras[n].sigma_px[:, None]
            for a, b in pairs
            for n in "AB"
        ]
    )
    codes = []
    for a, b in pairs:
        for true, seen in zip(a.code, b.code, strict=True):
            moved = np.einsum("nij,nj->ni", seen.jacobian, true.camera_px - seen.camera_px)
            codes.append((seen.position_px + moved - true.position_px) / seen.sigma_px[:, None])
    for ratio in (corners, np.concatenate(codes)):
        assert ratio.std() == pytest.approx(1, abs=4 / np.sqrt(2 * ratio.size))
    sigma = np.concatenate([view.cameras["A"].sigma_px for view in noisy.views])
    assert np.sqrt((sigma**2).mean()) == pytest.approx(0.05)
    assert sigma.std() > 0.01


def test_devices_that_are_not_asked_for_see_nothing():
    found = observations(RIG, BOARD, PLACES, devices=("A",))
    assert (found.devices, found.projector_px, found.views[0].code) == (("A",), None, ())


def test_the_expected_covariance_is_the_inverse_of_the_whole_problems_information():
    flat = replace(BOARD, sagitta_mm=0.0)
    places = [T for T in PLACES if see_board(RIG, flat, T)["projector"].inside.all()]
    rig = with_expected_covariance(RIG, flat, places, 0.05, ("fx", "fy", "cx", "cy"), 1e-3)
    n = len(rig.covariance_parameters)
    assert n == 12 + 2 * 6

    def pixels(values):
        changed, out = rig.changed(values[:n]), []
        for k, T in enumerate(places):
            T_A_board = exp_se3(values[n + 6 * k : n + 6 * k + 6]) @ RIG.cameras["A"].T_camera_sensor @ T
            points = transform_points(T_A_board, flat.points_board)
            out += [device.project(points).ravel() for device in changed.devices.values()]
        return np.concatenate(out) / 0.05

    steps = 1e-5 * np.eye(n + 6 * len(places))
    J = np.array([(pixels(h) - pixels(-h)) / 2e-5 for h in steps]).T
    expected = np.linalg.inv(J.T @ J)[:n, :n]
    growth = np.zeros(n)
    for device in ("B", "projector"):
        first = rig.covariance_parameters.index(f"{device}.translation_x")
        growth[first : first + 3] = 1e-3 * rig.devices[device].T_camera_sensor[:3, 3]
    expected += np.outer(growth, growth)
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((rig.covariance - expected) / np.outer(sigma, sigma)).max() < DIFFERENCES
    assert rig.covariance_parameters[:4] == ("A.fx", "A.fy", "A.cx", "A.cy")


def test_parallel_boards_leave_the_rig_open():
    flat = replace(BOARD, sagitta_mm=0.0)
    places = board_places(RIG, flat, 1, tilt_deg=0.0) * 3
    with pytest.raises(InputError, match="leave parameters of the rig open"):
        with_expected_covariance(RIG, flat, places)


def test_drawn_rigs_spread_as_the_covariance_says():
    names = ("A.fx", "B.k1", "B.rotation_y")
    covariance = np.diag([4.0, 1e-4, 1e-8]) + 1e-3 * np.array([[0, 10, 0], [10, 0, 0], [0, 0, 0]])
    rig = replace(RIG, covariance=covariance, covariance_parameters=names)
    drawn = [draw_rig(rig, seed) for seed in range(2000)]
    turns = [(item.cameras["B"].T_camera_sensor @ np.linalg.inv(RIG.cameras["B"].T_camera_sensor)) for item in drawn]
    values = np.array(
        [
            [
                item.cameras["A"].K[0, 0] - RIG.cameras["A"].K[0, 0],
                item.cameras["B"].distortion[0] - RIG.cameras["B"].distortion[0],
                turn[0, 2],
            ]
            for item, turn in zip(drawn, turns, strict=True)
        ]
    )
    sigma = np.sqrt(np.diag(covariance))
    # Four standard deviations of a variance from 2000 numbers.
    assert np.abs(np.cov(values.T) / np.outer(sigma, sigma) - covariance / np.outer(sigma, sigma)).max() < 0.13
    assert np.array_equal(draw_rig(rig, 7).cameras["A"].K, drawn[7].cameras["A"].K)
    with pytest.raises(InputError, match="has no covariance"):
        draw_rig(RIG, 0)
