"""Rendered boards against OpenCV's detectors, which know nothing of the simulator."""

from functools import cache

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import erf

from planish.errors import InputError
from planish.geometry import transform_points
from planish.sensing.capture.board import board_points, parse_board
from planish.simulation.board_places import board_places, see_board
from planish.simulation.board_runs import board_scene
from planish.simulation.boards import PrintedBoard
from planish.simulation.render import render_capture
from planish.simulation.sensor import Sensor, reference_rig

RIG = reference_rig(0.5)
#: A lens of known blur and nothing else.
CLEAN = Sensor(noise_factor=0, prnu=0, dust=0, bits=16)
#: Corners found by cornerSubPix: its own error in a perfect image is 0.022 px rms, without bias.
CORNER_PX = 0.03
#: What perspective within its window leaves of the mean.
BIAS_PX = 0.006
#: Of a fit that knows what a corner looks like, apart from perspective and distortion within its window.
SADDLE_PX = 0.01
#: A point is the right one within this: neighbours are 20 px away; OpenCV is up to 0.3 px off on steep boards.
LABEL_PX = 0.5
KINDS = {
    "chessboard": {"kind": "chessboard", "corners": [11, 8], "pitch_mm": 20},
    "charuco": {"kind": "charuco", "squares": [11, 8], "pitch_mm": 22, "marker_mm": 15.7},
    "legacy charuco": {"kind": "charuco", "squares": [11, 8], "pitch_mm": 22, "marker_mm": 16, "legacy": True},
    "circles": {"kind": "circles", "circles": [9, 7], "pitch_mm": 25, "diameter_mm": 14},
    "asymmetric circles": {"kind": "asymmetric_circles", "circles": [4, 11], "pitch_mm": 18, "diameter_mm": 16},
}


def make_board(kind, **changes):
    return PrintedBoard(parse_board({"schema": "planish.board/1", **KINDS[kind]}, kind), **changes)


@cache
def rendered(kind):
    board = make_board(kind)
    places = board_places(RIG, board, 3, seed=5)
    scene = board_scene(RIG, board, places, sensor=CLEAN)
    images = [{name: stack[0] for name, stack in render_capture(scene, i, 2).items()} for i in range(len(places))]
    return board, places, images


def eight_bit(image):
    return np.round(image / 257).astype(np.uint8)


def all_views(kind):
    board, places, images = rendered(kind)
    for T, pair in zip(places, images, strict=True):
        seen = see_board(RIG, board, T)
        for camera, image in pair.items():
            yield image, seen[camera].pixel_px


def test_corners_lie_where_the_true_points_project_to():
    errors = []
    for image, true_px in all_views("chessboard"):
        start = true_px.astype(np.float32) + np.float32(0.4)
        found = cv2.cornerSubPix(eight_bit(image), start[:, None].copy(), (4, 4), (-1, -1), (3, 100, 1e-4))
        errors.append(found.reshape(-1, 2) - true_px)
    errors = np.concatenate(errors)
    assert np.sqrt((errors**2).mean()) < CORNER_PX
    assert np.abs(errors.mean(0)).max() < BIAS_PX


def saddle(image, around_px, across_x, across_y):
    """Place (2,) of a corner by least squares: two blurred edges along the board's axes, which are known."""
    to_board = np.linalg.inv(np.column_stack([across_x, across_y]))
    to_board /= np.linalg.norm(to_board, axis=1)[:, None]
    first = np.round(around_px).astype(int) - 4
    patch = image[first[1] : first[1] + 9, first[0] : first[0] + 9] / 257.0
    pixels = np.stack(np.meshgrid(np.arange(9), np.arange(9)), -1) + first

    def residual(q):
        distance = (pixels - q[:2]) @ to_board.T / q[4]
        return (q[2] + q[3] * erf(distance[..., 0]) * erf(distance[..., 1]) - patch).ravel()

    start = [*(around_px + 0.2), patch.mean(), np.ptp(patch) / 2, 1.0]
    return least_squares(residual, start).x[:2]


def test_a_fit_of_blurred_edges_finds_corners_to_a_few_thousandths_of_a_pixel():
    errors = []
    for image, true_px in all_views("chessboard"):
        grid = true_px.reshape(8, 11, 2)
        for row, column in ((2, 2), (2, 8), (5, 5), (6, 3)):
            x = grid[row, column + 1] - grid[row, column - 1]
            y = grid[row + 1, column] - grid[row - 1, column]
            errors.append(saddle(image, grid[row, column], x, y) - grid[row, column])
    assert np.abs(errors).max() < SADDLE_PX


def test_a_chessboard_is_found_with_its_points_in_a_row_and_not_mirrored():
    for image, true_px in all_views("chessboard"):
        found, corners = cv2.findChessboardCornersSB(eight_bit(image), (11, 8))
        assert found
        corners = corners.reshape(-1, 2)
        # OpenCV starts at one end or the other.
        error = min(np.abs(corners - true_px).max(), np.abs(corners[::-1] - true_px).max())
        assert error < LABEL_PX


@pytest.mark.parametrize("kind", ["charuco", "legacy charuco"])
def test_a_charuco_board_is_found_with_the_ids_that_opencv_gives(kind):
    board = make_board(kind).board
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    layout = cv2.aruco.CharucoBoard(board.squares, board.pitch_mm, board.marker_mm, dictionary)
    layout.setLegacyPattern(board.legacy)
    detector = cv2.aruco.CharucoDetector(layout)
    for image, true_px in all_views(kind):
        corners, ids, _, markers = detector.detectBoard(eight_bit(image))
        # OpenCV misses single markers of steep boards.
        assert len(markers) >= 40
        assert sorted(np.ravel(ids)) == list(range(70))
        assert np.abs(corners.reshape(-1, 2) - true_px[np.ravel(ids)]).max() < LABEL_PX
    other = cv2.aruco.CharucoBoard(board.squares, board.pitch_mm, board.marker_mm, dictionary)
    other.setLegacyPattern(not board.legacy)
    _, ids, _, _ = cv2.aruco.CharucoDetector(other).detectBoard(eight_bit(image))
    assert ids is None or len(ids) == 0


@pytest.mark.parametrize("kind", ["charuco", "legacy charuco"])
def test_a_charuco_print_is_the_picture_that_opencv_makes(kind):
    board = make_board(kind)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    layout = cv2.aruco.CharucoBoard(board.board.squares, 60, 36, dictionary)
    layout.setLegacyPattern(board.board.legacy)
    picture = layout.generateImage((660, 480))
    same = PrintedBoard(board.board.model_copy(update={"pitch_mm": 60.0, "marker_mm": 36.0}))
    v, u = np.mgrid[:480, :660]
    # The print starts one square before point (0, 0); the surface's t goes up.
    middle = np.array([same.surface.half_s, same.surface.half_t]) - 30
    st = np.stack([u + 0.5 - middle[0], middle[1] - v - 0.5], -1).reshape(-1, 2)
    dark = same.printed.factor(st).reshape(480, 660) < 0.5
    assert (dark == (picture < 128)).mean() > 0.999


@pytest.mark.parametrize(("kind", "grid"), [("circles", (9, 7)), ("asymmetric circles", (4, 11))])
def test_discs_are_found_in_order(kind, grid):
    flags = cv2.CALIB_CB_SYMMETRIC_GRID if kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
    for image, true_px in all_views(kind):
        found, centres = cv2.findCirclesGrid(eight_bit(image), grid, flags=flags)
        assert found
        centres, expected = (px.reshape(grid[1], grid[0], 2) for px in (centres, true_px))
        # OpenCV starts a symmetric grid at any of its corners.
        orders = [expected, expected[::-1, ::-1], expected[::-1], expected[:, ::-1]]
        assert min(np.abs(centres - order).max() for order in orders[: 4 if kind == "circles" else 1]) < LABEL_PX


def test_z_points_into_the_board_and_y_down_the_rows():
    board = make_board("chessboard")
    for T in board_places(RIG, board, 5, seed=1):
        for device in RIG.devices.values():
            origin, x, y = device.project(transform_points(T, board.points_board[[0, 1, 11]]))
            assert np.linalg.det([x - origin, y - origin]) > 0
            assert (T[:3, 3] - device.center_sensor) @ T[:3, 2] > 0


def test_the_points_of_a_true_board_are_those_of_its_file():
    for kind in KINDS:
        board = make_board(kind)
        assert np.allclose(board.points_board, board_points(board.board), atol=1e-12)


@pytest.mark.parametrize("sagitta_mm", [1.0, -2.5])
@pytest.mark.parametrize("axis_deg", [0.0, 90.0, 45.0])
def test_a_bent_board_keeps_its_lengths_and_has_its_sagitta(sagitta_mm, axis_deg):
    board = make_board("chessboard", sagitta_mm=sagitta_mm, bend_axis_deg=axis_deg)
    points = board.points_board
    across = np.array([np.sin(np.deg2rad(axis_deg)), -np.cos(np.deg2rad(axis_deg))])
    # z points away from the sensor, so that the border of a board that bulges out lies deeper.
    assert np.abs(points[:, 2]).min() < abs(sagitta_mm) / 20
    assert points[:, 2][np.abs(points[:, 2]).argmax()] == pytest.approx(sagitta_mm, rel=1e-4)
    flat = board_points(board.board)[:, :2]
    middle = (flat.min(0) + flat.max(0)) / 2
    along = np.array([across[1], -across[0]])
    assert np.allclose((points[:, :2] - middle) @ along, (flat - middle) @ along, atol=1e-9)
    row = points.reshape(8, 11, 3)
    lengths = np.linalg.norm(np.diff(row, axis=1), axis=2)
    # A chord is shorter than its arc by (20 / 2400)^2 / 24.
    assert np.allclose(lengths, 20, rtol=1e-5)


@pytest.mark.parametrize("sagitta_mm", [4.0, -4.0])
def test_a_bent_board_with_wrong_pitch_is_rendered_where_its_true_points_project_to(sagitta_mm):
    board = make_board("chessboard", sagitta_mm=sagitta_mm, bend_axis_deg=30.0, scale=(1.0, 1.004))
    places = board_places(RIG, board, 2, seed=3)
    scene = board_scene(RIG, board, places, sensor=CLEAN)
    for index, T in enumerate(places):
        for camera, stack in render_capture(scene, index, 2).items():
            true_px = see_board(RIG, board, T)[camera].pixel_px
            start = true_px.astype(np.float32)[:, None].copy()
            found = cv2.cornerSubPix(eight_bit(stack[0]), start, (4, 4), (-1, -1), (3, 100, 1e-4)).reshape(-1, 2)
            assert np.sqrt(((found - true_px) ** 2).mean()) < CORNER_PX


def test_places_cover_the_images_and_are_tilted_about_all_directions():
    board = make_board("chessboard")
    places = board_places(RIG, board, 20, seed=2)
    normals = np.array([T[:3, 2] for T in places])
    tilt = np.rad2deg(np.arccos(-normals[:, 2]))
    assert tilt.max() > 25
    assert np.ptp(normals[:, 0]) > 0.6
    assert np.ptp(normals[:, 1]) > 0.6
    for camera in "AB":
        width, height = RIG.cameras[camera].size_px
        pixels = np.concatenate([see_board(RIG, board, T)[camera].pixel_px for T in places])
        assert (pixels >= 5).all()
        assert (pixels <= [width - 6, height - 6]).all()
        cells = np.histogram2d(*pixels.T, (8, 6), ((0, width), (0, height)))[0]
        assert (cells > 0).mean() > 0.9
    again = board_places(RIG, board, 20, seed=2)
    assert np.array_equal(again, places)
    assert not np.allclose(board_places(RIG, board, 1, seed=3)[0], places[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": (1.0, -1.0)}, "scale"),
        ({"margin_mm": -1.0}, "margin_mm"),
        ({"ink": 1.0}, "ink"),
        ({"sagitta_mm": 100.0}, "sagitta_mm"),
        ({"bend_axis_deg": float("nan")}, "bend_axis_deg"),
    ],
)
def test_a_board_that_cannot_be_made_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        make_board("chessboard", **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dictionary": "9X9_7"}, "dictionary"),
        ({"squares": (20, 20)}, "has 50 markers"),
        ({"marker_mm": 22.0}, "marker_mm"),
    ],
)
def test_a_charuco_board_that_cannot_be_printed_is_refused(changes, message):
    board = make_board("charuco").board
    with pytest.raises(InputError, match=message):
        PrintedBoard(board.model_copy(update=changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tilt_deg": 90.0}, "tilt_deg"),
        ({"depth": (1.2, 1.0)}, "depth"),
        ({"devices": ("C",)}, "devices"),
        ({"seen_share": 0.0}, "seen_share"),
        ({"depth": (0.3, 0.3)}, "fits into the images of A, B at 0 of 2"),
    ],
)
def test_places_that_do_not_exist_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        board_places(RIG, make_board("chessboard"), 2, **changes)
