"""Points of every kind of board in drawn images, against their true places."""

import numpy as np
import pytest

from drawn_boards import disc_centers, draw, looking_down, placed
from planish.sensing.calibrate.boards.detect import detect_board
from planish.sensing.calibrate.observations import BoardPoints
from planish.sensing.calibrate.symmetry import names_alike
from planish.sensing.capture.board import board_points, parse_board

#: Rms of a coordinate without noise: what 8 bit and drawing leave (seen: 0.0007 to 0.003). OpenCV's own corners are off
#: by 0.02 (cornerSubPix) to 0.05 px (SB) in the same images.
BIAS_PX = 0.004
#: Of markers drawn without smooth edges, on a board that the rim cuts (seen: 0.006).
COARSE_PX = 0.01
#: Errors over predicted sigma, rms over some fifty points: chance is 10 %, and the model's share of sigma is a bound.
SIGMA_RATIO = (0.6, 1.3)
#: Curved lines by a lens with 40 px of distortion (seen: 0.0011; 0.007 with straight edges).
BENT_PX = 0.003

TILTS = {"upright": (0.3, -0.2, 0.1), "upside down": (0.2, 0.4, 0.1 + np.pi), "on its side": (-0.2, 0.3, 1.5)}


def board(**fields):
    return parse_board({"schema": "planish.board/1", "pitch_mm": 10, **fields}, "board.json")


CHESSBOARD = board(kind="chessboard", corners=[9, 6])
BOARDS = {
    "chessboard of a single turn": CHESSBOARD,
    "chessboard of two turns": board(kind="chessboard", corners=[9, 7]),
    "chessboard of four turns": board(kind="chessboard", corners=[6, 6]),
    "charuco": board(kind="charuco", squares=[8, 6], marker_mm=7),
    "charuco, legacy": board(kind="charuco", squares=[8, 6], marker_mm=7, legacy=True, dictionary="5X5_100"),
    "circles": board(kind="circles", circles=[8, 6], diameter_mm=5),
    "circles of unequal pitches": board(kind="circles", circles=[7, 4], diameter_mm=6, pitch_mm=[10, 16]),
    "asymmetric circles, odd": board(kind="asymmetric_circles", circles=[4, 9]),
    "asymmetric circles, even": board(kind="asymmetric_circles", circles=[4, 8]),
}


def errors(found, printed, truth):
    """Differences (n, 2) from the true places, as seen after whichever turn of the board fits."""
    assert isinstance(found, BoardPoints), found
    return min((found.pixel_px - truth[turn[found.index]] for turn in names_alike(printed)), key=lambda e: (e**2).sum())


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("name", BOARDS)
@pytest.mark.parametrize("tilt", ["upright", "upside down"])
def test_points_are_found_where_they_are(name, tilt):
    printed, camera = BOARDS[name], looking_down()
    T = placed(printed, camera, TILTS[tilt], fill=0.95)
    image, truth = draw(printed, camera, T, supersampling=4 if "charuco" in name else 3)
    found = detect_board(image, printed)
    if "circles" in name:
        truth = disc_centers(printed, camera, T)
    error = errors(found, printed, truth)
    assert len(error) > 0.9 * len(truth)
    assert rms(error) < BIAS_PX
    assert np.array_equal(found.index, np.sort(found.index))


@pytest.mark.parametrize("name", ["chessboard of a single turn", "charuco", "circles"])
def test_the_noise_of_points_is_as_predicted(name):
    printed, camera = BOARDS[name], looking_down()
    T = placed(printed, camera, TILTS["upright"], fill=0.9)
    image, truth = draw(printed, camera, T, supersampling=4, noise=3.0)
    if "circles" in name:
        truth = disc_centers(printed, camera, T)
    found = detect_board(image, printed)
    ratio = rms(errors(found, printed, truth) / found.sigma_px[:, None])
    assert SIGMA_RATIO[0] < ratio < SIGMA_RATIO[1]


def test_lines_bent_by_the_lens_do_not_pull_the_corners():
    camera = looking_down(focal_px=320.0, distortion=(-0.3, 0.1, 0, 0))
    image, truth = draw(CHESSBOARD, camera, placed(CHESSBOARD, camera, TILTS["upright"], fill=0.95), supersampling=4)
    assert rms(errors(detect_board(image, CHESSBOARD), CHESSBOARD, truth)) < BENT_PX


@pytest.mark.parametrize("light", [False, True])
def test_discs_may_be_dark_or_light(light):
    printed, camera = BOARDS["circles"], looking_down()
    T = placed(printed, camera, (0.1, 0.1, 0), fill=0.9)
    image, _ = draw(printed, camera, T, supersampling=3, light=light)
    assert rms(errors(detect_board(image, printed), printed, disc_centers(printed, camera, T))) < BIAS_PX


def test_sixteen_bits_that_are_not_all_used_give_the_same_points():
    camera = looking_down()
    T = placed(CHESSBOARD, camera, TILTS["upright"], fill=0.9)
    grey, truth = draw(CHESSBOARD, camera, T, supersampling=3, bits=0)
    dim = np.round(grey * 4).astype(np.uint16)
    assert rms(errors(detect_board(dim, CHESSBOARD), CHESSBOARD, truth)) < BIAS_PX


@pytest.mark.parametrize("tilt", TILTS)
def test_the_colours_of_squares_name_the_points_of_a_board_that_looks_different_upside_down(tilt):
    camera = looking_down()
    image, truth = draw(CHESSBOARD, camera, placed(CHESSBOARD, camera, TILTS[tilt], fill=0.7), supersampling=2)
    found = detect_board(image, CHESSBOARD)
    assert np.abs(found.pixel_px - truth[found.index]).max() < 0.1


@pytest.mark.parametrize("name", BOARDS)
@pytest.mark.parametrize("tilt", TILTS)
def test_no_order_is_mirrored(name, tilt):
    printed, camera = BOARDS[name], looking_down((280, 210), 630.0)
    image, truth = draw(printed, camera, placed(printed, camera, TILTS[tilt], fill=0.7), supersampling=2, noise=1)
    assert np.abs(errors(detect_board(image, printed), printed, truth)).max() < 0.3


def test_part_of_a_charuco_board_is_enough():
    printed, camera = BOARDS["charuco"], looking_down()
    T = placed(printed, camera, TILTS["upright"], fill=1.6)
    image, truth = draw(printed, camera, T, supersampling=3)
    found = detect_board(image, printed)
    assert 8 <= len(found.index) < len(truth)
    assert rms(found.pixel_px - truth[found.index]) < COARSE_PX


def test_points_under_the_mask_are_left_out():
    camera = looking_down()
    image, truth = draw(CHESSBOARD, camera, placed(CHESSBOARD, camera, fill=0.8), supersampling=2)
    mask = np.ones(image.shape, bool)
    mask[:, : int(truth[::9, 0].max()) + 3] = False
    found = detect_board(image, CHESSBOARD, mask)
    assert set(found.index) == {k for k in range(54) if k % 9 != 0}


def test_a_figure_that_is_covered_is_left_out_alone():
    camera = looking_down()
    image, truth = draw(CHESSBOARD, camera, placed(CHESSBOARD, camera, fill=0.8), supersampling=2)
    u, v = np.round(truth[22]).astype(int)
    # Small enough for OpenCV still to see a chessboard.
    image[v : v + 5, u - 7 : u + 7] = 110
    found = detect_board(image, CHESSBOARD)
    assert set(range(54)) - set(found.index) == {22}


@pytest.mark.parametrize(
    ("stated", "reason"),
    [
        (board(kind="chessboard", corners=[10, 7]), "board"),
        (board(kind="chessboard", corners=[5, 5]), "is the board larger?"),
        (board(kind="chessboard", corners=[8, 7]), "no board found"),
    ],
)
def test_a_board_of_another_size_is_no_board(stated, reason):
    printed, camera = BOARDS["chessboard of two turns"], looking_down()
    image, _ = draw(printed, camera, placed(printed, camera, TILTS["upright"], fill=0.9), supersampling=2)
    found = detect_board(image, stated)
    assert isinstance(found, str)
    assert reason in found


@pytest.mark.parametrize("name", ["circles", "asymmetric circles, odd", "chessboard of two turns"])
@pytest.mark.parametrize("paper_mm", [7.0, 10.5, 12.0])
def test_the_edges_of_the_paper_are_no_further_points(name, paper_mm):
    printed, camera = BOARDS[name], looking_down()
    T = placed(printed, camera, TILTS["upright"], fill=0.9)
    paper_mm += 5 if "chessboard" in name else 0
    image, truth = draw(printed, camera, T, supersampling=2, paper_mm=paper_mm)
    assert len(errors(detect_board(image, printed), printed, truth)) == len(truth)


def test_a_smaller_grid_of_circles_is_not_cut_out_of_a_larger_one():
    printed, camera = BOARDS["circles"], looking_down()
    image, _ = draw(printed, camera, placed(printed, camera, TILTS["upright"], fill=0.9), supersampling=2)
    found = detect_board(image, board(kind="circles", circles=[7, 6]))
    assert isinstance(found, str)
    assert "is the board larger?" in found


@pytest.mark.parametrize(("level", "reason"), [(4, "too dark"), (255, "saturated"), (120, "no board found")])
def test_images_without_a_board_say_why(level, reason):
    found = detect_board(np.full((100, 120), level, np.uint8), CHESSBOARD)
    assert isinstance(found, str)
    assert reason in found


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("chessboard of a single turn", 1), ("chessboard of two turns", 2), ("chessboard of four turns", 4),
        ("charuco", 1), ("circles", 2), ("asymmetric circles, odd", 1), ("asymmetric circles, even", 2),
    ],
)  # fmt: skip
def test_a_board_has_as_many_names_as_turns_that_leave_it_alike(name, number):
    found = names_alike(BOARDS[name])
    assert len(found) == number
    assert np.array_equal(found[0], np.arange(len(board_points(BOARDS[name]))))
    half = np.arange(len(found[0]))[::-1]
    assert any(np.array_equal(turn, half) for turn in found) == (number > 1)


def test_a_quarter_turn_moves_a_square_boards_points_to_the_next_sides():
    quarter = names_alike(board(kind="circles", circles=[3, 3]))[1]
    assert np.array_equal(quarter[quarter], np.arange(9)[::-1])
