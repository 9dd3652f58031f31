"""Calibrations of simulated boards: as good as they say, the same optimum as OpenCV, stable with few views."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibrated import AB, NOISE_PX, altered, errors, finding, made, nees, seen, warnings
from planish.options import thread_count
from planish.rig.parameters import EXTERNAL
from planish.sensing.calibrate.adjust.equations import equations, solve
from planish.sensing.calibrate.adjust.linear import linearise, moved
from planish.sensing.calibrate.adjust.problem import Free, State, problem_of
from planish.sensing.calibrate.calibrate import CalibrateOptions, calibrate
from planish.sensing.calibrate.observations import BoardPoints
from planish.sensing.capture.board import board_points
from planish.simulation.sensor import reference_rig

#: One draw: its largest of about 30 normalised errors exceeds this in one of a thousand.
LARGEST_ERROR = 4.0
#: NEES / dof of one draw of 16 to 30 degrees of freedom lies below with probability 0.999.
LARGEST_NEES = 2.5
#: Share by which the noise found may differ from the noise drawn (thousands of residuals).
NOISE_SHARE = 0.05
#: Parameters of two adjustments to the same optimum differ by less than this share of their standard deviation.
SAME_OPTIMUM = 0.02
#: Probability of losing a point for comparisons with those who do not look for outliers.
NO_OUTLIERS = 1e-9
#: Views of one camera alone say little beside pairs, but something: share of the variance that is left at most.
LEFT_VARIANCE = 0.95


@pytest.mark.parametrize("devices", [AB, ("A", "projector"), ("A", "B", "projector"), ("A",)], ids=str)
def test_the_parameters_are_within_their_standard_deviations(devices):
    found = calibrate(seen(views=20, devices=devices))
    normalised = errors(found) / np.sqrt(np.diag(found.rig.covariance))
    assert np.abs(normalised).max() < LARGEST_ERROR
    assert nees(found) < LARGEST_NEES
    assert warnings(found) == []
    for device in devices:
        assert found.noise_px[device] == pytest.approx(NOISE_PX, rel=NOISE_SHARE)
        assert set(found.models[device].coefficients) >= {"k1", "k2"}
        assert found.rms_px(device) <= found.left_out_rms_px[device]
        assert found.left_out_rms_px[device] == pytest.approx(np.sqrt(2) * NOISE_PX, rel=NOISE_SHARE)


def test_the_result_says_what_it_rests_on():
    item = seen()
    found = calibrate(item)
    intrinsics = ("fx", "fy", "cx", "cy", "k1", "k2")
    expected = [f"A.{n}" for n in intrinsics] + [f"B.{n}" for n in (*intrinsics, *EXTERNAL)]
    assert list(found.rig.covariance_parameters) == expected
    np.testing.assert_array_equal(found.rig.cameras["A"].T_camera_sensor, np.eye(4))
    assert list(found.T_A_board) == [view.name for view in item.views]
    assert sum(len(r.index) for r in found.residuals) == sum(
        len(p.index) for v in item.views for p in v.cameras.values()
    )
    first = found.residuals[0]
    points = board_points(item.board)[first.index] @ found.T_A_board[first.view][:3, :3].T
    predicted = found.rig.cameras["A"].project(points + found.T_A_board[first.view][:3, 3])
    np.testing.assert_allclose(first.pixel_px, predicted, atol=1e-9)
    np.testing.assert_allclose(first.pixel_px + first.residual_px, item.views[0].cameras["A"].pixel_px, atol=1e-9)


def test_any_number_of_threads_gives_the_same_bytes():
    one, many = (calibrate(seen(views=8), threads=n).rig for n in (1, max(2, thread_count())))
    assert one.to_json() == many.to_json()


def test_the_derivatives_of_the_residuals_are_those_of_central_differences():
    item = problem_of(seen(views=3, devices=("A", "B", "projector")))
    rig = reference_rig().in_frame_of("A")
    lens = ("k1", "k2", "p1", "p2", "k3")
    free = Free.of(dict.fromkeys(item.devices, lens), "A")
    places = np.stack([np.eye(4)] * 3)
    places[:, :3, 3] = [[-80, -60, 900], [-100, -70, 850], [-90, -50, 800]]
    state = State(rig.devices, places, np.empty(0))
    steps = np.where(["rotation" in n or n.partition(".")[2] in lens for n in free.names], 1e-6, 1e-3)
    for block in item.blocks:
        line = linearise(item, state, free, block)
        for column, place in enumerate(line.columns):
            change = steps[place] * (np.arange(free.size) == place)
            ahead, back = (
                linearise(item, moved(item, state, free, s * change, np.zeros((3, 6))), free, block) for s in (1, -1)
            )
            expected = (back.residual_px - ahead.residual_px) / (2 * steps[place])
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(line.jacobian[..., column] / scale, expected / scale, atol=1e-5)
        for k in range(6):
            change = np.tile(1e-5 * (np.arange(6) == k), (3, 1))
            ahead, back = (
                linearise(item, moved(item, state, free, np.zeros(free.size), s * change), free, block) for s in (1, -1)
            )
            expected = (back.residual_px - ahead.residual_px) / 2e-5
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(line.jacobian[..., k - 6] / scale, expected / scale, atol=1e-5)


def test_eliminating_the_places_gives_the_step_of_the_whole_system():
    item = problem_of(seen(views=4))
    free = Free.of({"A": ("k1",), "B": ("k1",)}, "A")
    places = np.stack([np.eye(4)] * 4)
    places[:, :3, 3] = [[-80, -60, 900], [-100, -70, 850], [-90, -50, 800], [-60, -50, 870]]
    state = State(reference_rig().in_frame_of("A").devices, places, np.empty(0))
    lines = [linearise(item, state, free, block) for block in item.blocks]
    weights = [np.where(block.seen, 4.0, 0.0) for block in item.blocks]
    change, steps = solve(equations(item, state, free, lines, weights))
    J, r = np.zeros((0, free.size + 24)), []
    for line in lines:
        for row, v in enumerate(line.rows):
            part = np.zeros((line.jacobian.shape[1] * 2, free.size + 24))
            whole = line.jacobian[row].reshape(len(part), -1)
            part[:, line.columns], part[:, free.size + 6 * v : free.size + 6 * v + 6] = whole[:, :-6], whole[:, -6:]
            J, r = np.vstack([J, part]), [*r, *line.residual_px[row].ravel()]
    expected = np.linalg.lstsq(J, np.array(r), rcond=None)[0]
    np.testing.assert_allclose(change, expected[: free.size], rtol=1e-6)
    np.testing.assert_allclose(steps.ravel(), expected[free.size :], rtol=1e-6, atol=1e-9)


def points_for_opencv(item, points):
    views = [view for view in item.views if set(AB) <= set(view.cameras)]
    both = [np.intersect1d(view.cameras["A"].index, view.cameras["B"].index) for view in views]
    pixels = {}
    for name in AB:
        pixels[name] = [
            view.cameras[name].pixel_px[np.isin(view.cameras[name].index, index)].astype(np.float32)
            for view, index in zip(views, both, strict=True)
        ]
    return [points[index].astype(np.float32) for index in both], pixels


def test_one_camera_finds_the_optimum_of_opencv():
    item = seen(devices=("A",))
    found = calibrate(item, CalibrateOptions(model="tangential", outlier_probability=NO_OUTLIERS))
    points = board_points(item.board).astype(np.float32)
    objects = [points[view.cameras["A"].index] for view in item.views]
    pixels = [view.cameras["A"].pixel_px.astype(np.float32) for view in item.views]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    rms, K, distortion, *_ = cv2.calibrateCamera(
        objects, pixels, item.size_px["A"], None, None, flags=cv2.CALIB_FIX_K3, criteria=criteria
    )
    camera = found.rig.cameras["A"]
    sigma = dict(zip(found.rig.covariance_parameters, np.sqrt(np.diag(found.rig.covariance)), strict=True))
    ours = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *camera.distortion[:4]]
    theirs = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()[:4]]
    for name, a, b in zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), ours, theirs, strict=True):
        assert abs(a - b) < SAME_OPTIMUM * sigma[f"A.{name}"], name
    assert found.rms_px("A") == pytest.approx(rms, rel=1e-3)


def test_two_cameras_find_the_optimum_of_opencv():
    item = seen()
    objects, pixels = points_for_opencv(item, board_points(item.board))
    both = calibrate(item_of_shared(item), CalibrateOptions(model="radial", outlier_probability=NO_OUTLIERS))
    start = both.rig
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    # OpenCV's start from the truth: it must walk to the optimum itself.
    true = reference_rig().cameras
    K, lens = [true[n].K.copy() for n in AB], [true[n].distortion[:5].copy() for n in AB]
    out = cv2.stereoCalibrate(
        objects,
        pixels["A"],
        pixels["B"],
        K[0],
        lens[0],
        K[1],
        lens[1],
        item.size_px["A"],
        flags=flags,
        criteria=criteria,
    )
    sigma = dict(zip(start.covariance_parameters, np.sqrt(np.diag(start.covariance)), strict=True))
    translation = start.cameras["B"].T_camera_sensor[:3, 3]
    theirs = np.ravel(out[6])
    for k, axis in enumerate("xyz"):
        assert abs(translation[k] - theirs[k]) < SAME_OPTIMUM * sigma[f"B.translation_{axis}"]
    for name, matrix in zip(AB, (out[1], out[3]), strict=True):
        assert abs(start.cameras[name].K[0, 0] - matrix[0, 0]) < SAME_OPTIMUM * sigma[f"{name}.fx"]


def item_of_shared(item):
    """Observations of the points that both cameras see."""
    views = []
    for view in item.views:
        shared = np.intersect1d(view.cameras["A"].index, view.cameras["B"].index)
        cameras = {}
        for name, p in view.cameras.items():
            keep = np.isin(p.index, shared)
            cameras[name] = BoardPoints(p.index[keep], p.pixel_px[keep], p.sigma_px[keep])
        views.append(replace(view, cameras=cameras))
    return replace(item, views=tuple(views))


@pytest.mark.parametrize("devices", [AB, ("A", "projector")], ids=str)
def test_three_views_are_enough_and_say_that_they_are_few(devices):
    found = calibrate(seen(views=3, devices=devices))
    assert nees(found) < LARGEST_NEES
    assert len([text for text in warnings(found) if "3 views of the board only" in text]) == 2
    assert all("weakly held" in model.sentence for model in found.models.values())


def test_a_view_that_one_device_alone_sees_counts():
    item = seen()
    views = tuple(
        replace(view, cameras={name: p for name, p in view.cameras.items() if k < 6 or name == AB[k % 2]})
        for k, view in enumerate(item.views)
    )
    few, all_views = (calibrate(replace(item, views=v)) for v in (views[:6], views))
    assert len(all_views.T_A_board) == 12
    assert nees(all_views) < LARGEST_NEES
    at = few.rig.covariance_parameters.index("A.fx")
    assert all_views.rig.covariance[at, at] < LEFT_VARIANCE * few.rig.covariance[at, at]


def test_stated_sigmas_of_single_points_count_as_weights():
    rng = np.random.default_rng(4)
    item = seen()
    for v in range(len(item.views)):
        for camera in AB:

            def blur(p):
                bad = np.arange(len(p.index)) % 3 == 0
                pixel = p.pixel_px + bad[:, None] * rng.normal(0, 0.5, p.pixel_px.shape)
                return replace(p, pixel_px=pixel, sigma_px=np.where(bad, np.hypot(0.5, NOISE_PX), NOISE_PX))

            item = altered(item, v, camera, blur)
    found = calibrate(item)
    assert nees(found) < LARGEST_NEES
    assert sum(int(r.outlier.sum()) for r in found.residuals) <= 3
    assert finding(found, "scale").value == 0.0
    assert made().board.pitch_sigma == found.scale[1]
