"""What calibrations say about boards that are not as stated, and about images that do not belong."""

from dataclasses import replace

import numpy as np
import pytest

from calibrated import AB, STATED, altered, finding, made, nees, seen, warnings
from planish.errors import InputError
from planish.geometry import exp_so3, transform_points
from planish.sensing.calibrate.adjust.discs import disc_shift
from planish.sensing.calibrate.calibrate import CalibrateOptions, calibrate
from planish.sensing.calibrate.symmetry import turns
from planish.sensing.capture.board import board_points, parse_board
from planish.simulation.board_places import board_places
from planish.simulation.boards import PrintedBoard
from planish.simulation.sensor import reference_rig
from seen_boards import observations

#: NEES / dof of one draw lies below with probability 0.999.
LARGEST_NEES = 2.5
#: NEES / dof of a calibration whose errors are far outside their standard deviations.
BIASED_NEES = 5.0
#: Rounding over the iterations, relative.
ROUNDING = 1e-7
#: What is found lies within so many of its standard deviations.
SIGMAS = 4.0


def test_a_pitch_ratio_is_reported_and_not_absorbed():
    found = calibrate(seen(views=20, board=made(scale=(1.0005, 0.9995))))
    ratio = finding(found, "pitch ratio x / y of the board")
    assert ratio.value == pytest.approx(1.0005 / 0.9995, abs=SIGMAS * ratio.sigma)
    assert ratio.sigma < 1e-4
    assert "'pitch_mm': [20.01, 19.99]" in ratio.warning
    assert nees(found) < LARGEST_NEES


def test_a_bent_board_is_reported_and_on_request_taken_as_it_is():
    item = seen(views=20, board=made(sagitta_mm=1.0))
    found = calibrate(item)
    bending = finding(found, "bending of the board")
    assert bending.value == pytest.approx(1.0, abs=SIGMAS * bending.sigma)
    assert bending.sigma < 0.05
    assert "the board is bent by 1 +-" in bending.warning
    assert nees(found) < LARGEST_NEES
    assert found.height_mm is None
    even = calibrate(item, CalibrateOptions(flatness=True))
    points = made(sagitta_mm=1.0).points_board
    true = -points[:, 2] - np.polynomial.polynomial.polyfit(points[:, 0], -points[:, 2], 0)[0]
    np.testing.assert_allclose(even.height_mm, true - true.mean(), atol=0.01)
    assert even.noise_px["A"] < 0.2 * found.noise_px["A"]
    assert nees(even) < LARGEST_NEES
    assert "bending of the board" not in [item.quantity for item in even.findings]


def test_a_good_board_is_not_blamed():
    found = calibrate(seen(seed=5))
    for quantity in ("pitch ratio x / y of the board", "shear of the board", "bending of the board"):
        assert finding(found, quantity).warning == ""


def known(length_mm, sigma_mm=0.01, pitch_sigma=1e-4):
    ends = {"first": (0, 0), "second": (10, 0), "length_mm": length_mm, "sigma_mm": sigma_mm}
    return made({"known_length": ends, "pitch_sigma": pitch_sigma})


def test_a_known_length_that_agrees_gives_the_scale():
    without = calibrate(seen(board=known(200.0, sigma_mm=1e3)))
    found = calibrate(seen(board=known(200.02)))
    # Weighted mean of 0 +- 1e-4 and 1e-4 +- 5e-5.
    assert found.scale == pytest.approx((0.8e-4, np.sqrt(0.2) * 1e-4), rel=1e-3)
    t, before = (item.rig.cameras["B"].T_camera_sensor[:3, 3] for item in (found, without))
    np.testing.assert_allclose(t, before * (1 + found.scale[0]), rtol=1e-7)
    assert warnings(found) == []


def test_a_known_length_that_contradicts_is_reported_and_widens_the_scale():
    found = calibrate(seen(board=known(200.2)))
    assert found.scale == (0.0, pytest.approx(1e-3))
    assert "contradicts the pitch" in finding(found, "known length against pitch").warning
    t = found.rig.cameras["B"].T_camera_sensor[:3, 3]
    names = found.rig.covariance_parameters
    part = [names.index(f"B.translation_{axis}") for axis in "xyz"]
    along = t / np.linalg.norm(t)
    assert along @ found.rig.covariance[np.ix_(part, part)] @ along > (1e-3 * np.linalg.norm(t)) ** 2


def test_a_known_length_needs_points_of_the_board():
    ends = {"first": (0, 0), "second": (11, 0), "length_mm": 220.0, "sigma_mm": 0.01}
    with pytest.raises(InputError, match=r"known_length.*\(11, 0\)"):
        calibrate(seen(board=made({"known_length": ends})))


@pytest.mark.parametrize("camera", AB)
def test_an_image_saved_upside_down_is_named_and_left_out(camera):
    size = np.array(reference_rig().cameras[camera].size_px)
    item = altered(seen(), 6, camera, lambda p: replace(p, pixel_px=size - 1.0 - p.pixel_px))
    found = calibrate(item)
    told = f"view 07: image {camera}/07.png does not fit; it would if it were turned by 180 degrees"
    assert [told in text for text in warnings(found)] == [True]
    assert ("07", camera) not in {(r.view, r.device) for r in found.residuals}
    assert "07" in found.T_A_board
    assert nees(found) < LARGEST_NEES


def test_points_numbered_from_the_other_end_are_numbered_anew():
    board = made({"corners": (10, 8), "pitch_mm": 22.0})
    rig = reference_rig()
    item = observations(rig, board, board_places(rig, board, 12, devices=AB, seen_share=0.8), seed=1, devices=AB)
    right = calibrate(item)
    _, half = turns(board.board)
    for view in (1, 4, 5, 9):
        item = altered(item, view, "B", lambda p: replace(p, index=half.becomes[p.index]))
    found = calibrate(item)
    numbered = [f.quantity for f in found.findings if f.quantity.startswith("numbering")]
    assert numbered == [f"numbering of the board in B/{n}.png" for n in ("02", "05", "06", "10")]
    for name, camera in found.rig.cameras.items():
        np.testing.assert_allclose(camera.K, right.rig.cameras[name].K, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ({"kind": "chessboard", "corners": (9, 7)}, [0, 2]),
        ({"kind": "circles", "circles": (7, 7)}, [0, 1, 2, 3]),
        ({"kind": "charuco", "squares": (9, 7), "marker_mm": 10.0}, [0]),
        ({"kind": "asymmetric_circles", "circles": (4, 11)}, [0]),
        ({"kind": "asymmetric_circles", "circles": (4, 10)}, [0, 2]),
    ],
)
def test_the_turns_of_a_board_are_those_that_put_points_onto_points(kind, expected):
    board = parse_board({"schema": "planish.board/1", "pitch_mm": 15.0, **kind}, "board")
    found = turns(board)
    assert [turn.quarters for turn in found] == expected
    for turn in found:
        points = board_points(board)
        np.testing.assert_allclose(transform_points(turn.T_board_board, points), points[turn.becomes], atol=1e-9)


def test_images_of_other_places_are_left_out_and_named():
    item = seen()
    views = list(item.views)
    for a, b in ((3, 4), (4, 3)):
        cameras = {**item.views[a].cameras, "B": item.views[b].cameras["B"]}
        views[a] = replace(item.views[a], cameras=cameras)
    found = calibrate(replace(item, views=tuple(views)))
    told = [text for text in warnings(found) if "contradicts" in text]
    assert [text[:8] for text in told] == ["view 04:", "view 05:"]
    assert nees(found) < LARGEST_NEES


def test_an_image_with_mixed_up_points_is_left_out_and_named():
    rng = np.random.default_rng(0)
    found = calibrate(altered(seen(), 4, "B", lambda p: replace(p, index=rng.permutation(p.index))))
    assert [text for text in warnings(found) if "image B/05.png does not fit" in text]
    assert nees(found) < LARGEST_NEES


def test_single_outliers_are_found_and_named():
    rng, item, wrong = np.random.default_rng(1), seen(), {}
    for v in range(len(item.views)):
        for camera in AB:
            points = item.views[v].cameras[camera]
            bad = rng.random(len(points.index)) < 0.05
            shift = bad[:, None] * rng.choice([-1, 1], (len(bad), 2)) * rng.uniform(1, 20, (len(bad), 2))
            wrong[item.views[v].name, camera] = bad
            item = altered(item, v, camera, lambda p, s=shift: replace(p, pixel_px=p.pixel_px + s))
    found = calibrate(item)
    for r in found.residuals:
        np.testing.assert_array_equal(r.outlier & wrong[r.view, r.device], wrong[r.view, r.device])
    assert sum(int((r.outlier & ~wrong[r.view, r.device]).sum()) for r in found.residuals) <= 2
    assert nees(found) < LARGEST_NEES


def test_an_image_of_a_single_row_of_the_board_is_named_and_not_used():
    item = seen()
    for view, keep in ((2, slice(0, 11)), (3, slice(0, 7))):
        item = altered(item, view, "B", lambda p, k=keep: replace(
            p, index=p.index[k], pixel_px=p.pixel_px[k], sigma_px=p.sigma_px[k]))  # fmt: skip
    found = calibrate(item)
    told = [text[:50] for text in warnings(found)]
    assert told == [f"view {n}: image B/{n}.png shows {k} points of the board"[:50] for n, k in (("03", 11), ("04", 7))]
    assert nees(found) < LARGEST_NEES


def test_too_few_views_are_refused():
    item = seen()
    with pytest.raises(InputError, match="camera A: found 2 usable views; expected at least 3"):
        calibrate(replace(item, views=item.views[:2]))


def test_parallel_boards_are_refused():
    rng, rig = np.random.default_rng(0), reference_rig()
    base = board_places(rig, made(), 1, 3, devices=AB, tilt_deg=0.0)[0]
    parallel = []
    for _ in range(12):
        T = base.copy()
        T[:3, 3] += rng.uniform(-30, 30, 3)
        T[:3, :3] = T[:3, :3] @ exp_so3(rng.normal(0, 0.005, 3))
        parallel.append(T)
    with pytest.raises(InputError, match=r"all 12 boards parallel within .*tilt them by 20 to 40 degrees"):
        calibrate(observations(rig, made(), parallel, devices=AB))


def test_cameras_that_see_nothing_in_common_are_refused():
    item = seen()
    views = tuple(replace(view, cameras={AB[k % 2]: view.cameras[AB[k % 2]]}) for k, view in enumerate(item.views))
    with pytest.raises(InputError, match="no view that camera B and camera A both see"):
        calibrate(replace(item, views=views))


def test_the_shift_of_a_disc_is_that_of_its_projected_area():
    camera = replace(reference_rig().cameras["A"], distortion=np.array([-0.3, 0.2, 2e-3, -1e-3, 0.1, *[0.0] * 7]))
    T = np.eye(4)
    T[:3, :3] = reference_rig().cameras["A"].T_camera_sensor[:3, :3].T @ exp_so3([0.5, -0.4, 0.2])
    T[:3, 3] = [40.0, 30.0, 10.0]
    radius, middles = 12.0, np.array([[0.0, 0, 0], [60, 0, 0], [-150, 80, 0]])
    found = disc_shift(camera, transform_points(T, middles)[None], T[None], radius)[0]
    # Green's theorem over the projected outline: area and first moments.
    angle = np.linspace(0, 2 * np.pi, 4001)[:-1]
    rim = radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    for middle, shift in zip(middles, found, strict=True):
        at = camera.project(transform_points(T, middle[None]))[0]
        x, y = (camera.project(transform_points(T, middle + rim)) - at).T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        area = 0.5 * cross.sum()
        centroid = [((w + np.roll(w, -1)) * cross).sum() / (6 * area) for w in (x, y)]
        assert np.linalg.norm(centroid) > 0.05
        # The next order of the disc's size: (12 mm / 800 mm)^2 of the shift.
        np.testing.assert_allclose(shift, centroid, atol=1e-3 * np.linalg.norm(centroid))


def test_the_shift_of_discs_is_corrected_where_their_diameter_is_known():
    rig, stated = reference_rig(), {"kind": "circles", "circles": (9, 7), "pitch_mm": 28.0}
    boards = [
        PrintedBoard(parse_board({"schema": "planish.board/1", **stated, **more}, "board"))
        for more in ({}, {"diameter_mm": 26.0})
    ]
    held = board_places(rig, boards[1], 12, devices=AB, seen_share=0.8)
    results = []
    for board in boards:
        item = observations(rig, board, held, 0.02, devices=AB)
        for v, T in enumerate(held):
            for name in item.views[v].cameras:
                seen_at = transform_points(T, board.points_board)[None]
                shift = disc_shift(rig.cameras[name], seen_at, T[None], 13.0)[0]
                item = altered(item, v, name, lambda p, s=shift: replace(p, pixel_px=p.pixel_px + s[p.index]))
        results.append(calibrate(item))
    without, corrected = results
    assert nees(corrected) < LARGEST_NEES
    # The lens and the places take the shift up: the noise would not tell.
    assert nees(without) > BIASED_NEES


#: Sheet that came off its plate at a corner of the board: heights [mm] of points (10, 0), (9, 0), (10, 1).
LIFTED = {(10, 0): 2.5, (9, 0): 1.0, (10, 1): 1.2}
#: Where a height is known from 20 views with corners of 0.05 px: 0.33 mm per pixel, 30 degrees of tilt, 40 images.
HEIGHT_MM = 0.05


class LiftedBoard(PrintedBoard):
    """A board whose sheet stands off at a corner."""

    @property
    def points_board(self):
        points = PrintedBoard.points_board.func(self).copy()
        for (column, row), height in LIFTED.items():
            points[row * self.board.grid[0] + column, 2] -= height
        return points


def test_a_sheet_that_stands_off_its_plate_is_named_and_on_request_measured():
    item = seen(board=LiftedBoard(parse_board(STATED, "board")))
    (warning,) = [text for text in warnings(calibrate(item)) if "points (column, row)" in text]
    assert "(10, 0)" in warning
    assert "flatness" in warning
    found = calibrate(item, CalibrateOptions(flatness=True))
    assert "each point on its own" in finding(found, "heights of the board's points").source
    assert not [text for text in warnings(found) if "points (column, row)" in text]
    points = LiftedBoard(parse_board(STATED, "board")).points_board
    # Heights are told against the plane through all points.
    plane = np.column_stack([np.ones(len(points)), points[:, :2]])
    true = -points[:, 2] + plane @ np.linalg.lstsq(plane, points[:, 2], rcond=None)[0]
    np.testing.assert_allclose(found.height_mm, true, atol=HEIGHT_MM)
    assert nees(found) < 2


def test_a_flat_board_gets_no_heights_of_its_points_one_by_one():
    found = calibrate(seen(), CalibrateOptions(flatness=True))
    told = finding(found, "heights of the board's points")
    assert told.value < HEIGHT_MM
    assert finding(found, "points of the board that are outliers in most of their images").value == 0
