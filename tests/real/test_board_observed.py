"""The real chessboard under a projector: what is seen of it, before any rig is known."""

import cv2
import numpy as np
import pytest
from captures import HERE, load

from planish.sensing.calibrate.boards.detect import detect_board
from planish.sensing.calibrate.boards.observe import observe_boards
from planish.sensing.capture.board import board_points

#: The map from camera to projector is smooth (a homography and a polynomial of fourth order) but for noise and for what
#: the taped paper's relief does along v, where the projector looks from above: seen 0.01 to 0.02 along u, 0.05 to 0.12.
SMOOTH_PX = (0.03, 0.15)
#: Where the board of one white image and of all patterns' mean lie apart: noise of either (seen 0.01).
SAME_PX = 0.02


@pytest.fixture(scope="module")
def seen():
    images = load("procam_board", "capture_0.json").images_dir
    return observe_boards(HERE / "procam_board" / "boards.json", images_dir=images)


def test_every_view_shows_the_whole_board_and_three_the_code_on_it(seen):
    assert seen.missed == {}
    assert seen.devices == ("A", "projector")
    assert [len(view.cameras["A"].index) for view in seen.views] == [63] * 5
    assert [[len(code.index) for code in view.code] for view in seen.views] == [[63], [63], [63], [], []]


def test_the_projectors_positions_follow_the_cameras_smoothly(seen):
    grid = board_points(seen.board)[:, :2] / 300 - 1
    terms = np.stack([grid[:, 0] ** i * grid[:, 1] ** j for i in range(5) for j in range(5 - i)], -1)
    for view in seen.views[:3]:
        (code,) = view.code
        H = cv2.findHomography(code.camera_px, code.position_px)[0]
        x = np.column_stack([code.camera_px, np.ones(63)]) @ H.T
        residual = code.position_px - x[:, :2] / x[:, 2:]
        rough = residual - terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
        assert np.all(np.sqrt((rough**2).sum(0) / (63 - terms.shape[1])) < SMOOTH_PX)


def test_the_board_lies_in_the_mean_of_the_patterns_where_it_lies_in_the_white_image(seen):
    capture = load("procam_board", "capture_0.json")
    mean = np.mean([capture.read_image("A", k) for k in range(0, 40)], axis=0, dtype=np.float32)
    found = detect_board(mean, seen.board)
    assert np.sqrt(np.mean((found.pixel_px - seen.views[0].cameras["A"].pixel_px) ** 2)) < SAME_PX
