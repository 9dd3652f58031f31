"""The projector's code on boards: positions at the board's points, against where they truly lie in the projector."""

import json

import cv2
import numpy as np
import pytest

from drawn_boards import draw, looking_down, placed
from planish.errors import InputError
from planish.sensing.calibrate.boards.observe import observe_boards
from planish.sensing.calibrate.symmetry import names_alike
from planish.sensing.capture.board import board_points, parse_board
from planish.sensing.patterns.encode import axis_of, encode
from planish.sensing.patterns.sequences import gray_sequence, multi_frequency_sequence, phase_shift_sequence

BOARD = {"schema": "planish.board/1", "kind": "chessboard", "corners": [5, 4], "pitch_mm": 10}
PRINTED = parse_board(BOARD, "board.json")
PROJECTOR_PX = (256, 200)
#: From the board's (x, y) [mm] to the projector (u, v) [px]: about two projector pixels per mm, seen aslant.
H_PROJECTOR_BOARD = np.array([[2.1, 0.15, 60], [-0.1, 2.0, 50], [4e-4, -3e-4, 1]])
TILT = (0.25, -0.2, 0.1)
#: Rms of the positions with noise of one grey level (seen: fringes 0.006, Gray code 0.012).
FRINGES_PX, GRAY_PX = 0.012, 0.025
#: Errors over predicted sigma, rms: some twenty points, whose errors by the Gray code's lean are alike.
SIGMA_RATIO = (0.4, 2.0)
#: The derivative against that of the true map, relative.
SLOPE = 0.02


def in_projector(xy):
    p = np.column_stack([xy, np.ones(len(xy))]) @ H_PROJECTOR_BOARD.T
    return p[:, :2] / p[:, 2:]


def camera():
    return looking_down((200, 160), 450.0)


def coded_capture(folder, sequence, noise=1.0, board=BOARD, **manifest):
    """A folder with one capture of the board under the images of a sequence; returns the true pixels of the points."""
    T = placed(PRINTED, camera(), TILT, fill=0.85)
    (folder / "01").mkdir(parents=True)
    names = []
    for k, entry in enumerate(sequence):

        def lit(x, y, entry=entry):
            position = in_projector(np.column_stack([x.ravel(), y.ravel()]))[:, "uv".index(axis_of(entry))]
            return encode(entry, position).reshape(x.shape)

        image, truth = draw(PRINTED, camera(), T, supersampling=4, noise=noise, seed=k, lit=lit)
        names.append(f"{k:02d}.png")
        cv2.imwrite(str(folder / "01" / names[-1]), image)
    content = {
        "schema": "planish.capture/1", "images": {"A": names}, "projector_px": PROJECTOR_PX,
        "sequence": [entry.model_dump(exclude_none=True) for entry in sequence], **manifest,
    }  # fmt: skip
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "01" / "capture.json").write_text(json.dumps(content))
    (folder / "board.json").write_text(json.dumps(board))
    return truth


SEQUENCES = {
    "fringes": (multi_frequency_sequence(PROJECTOR_PX, ("u", "v"), periods_px=(256, 32)), FRINGES_PX),
    "Gray code": (gray_sequence(PROJECTOR_PX, axes=("u", "v"), cell_px=2), GRAY_PX),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_the_code_puts_the_boards_points_where_they_are_in_the_projector(tmp_path, name):
    sequence, tolerance = SEQUENCES[name]
    pixels = coded_capture(tmp_path, sequence)
    seen = observe_boards(tmp_path)
    assert seen.devices == ("A", "projector")
    assert seen.projector_px == PROJECTOR_PX
    (code,) = seen.views[0].code
    assert len(code.index) >= 18
    # The map is evaluated at the pixel where the camera saw the point; there the truth is that of the camera's ray.
    H = np.linalg.inv(cv2.findHomography(board_points(PRINTED)[:, :2], pixels)[0])
    x = np.column_stack([code.camera_px, np.ones(len(code.index))]) @ H.T
    true = in_projector(x[:, :2] / x[:, 2:])
    error = code.position_px - true
    assert np.sqrt((error**2).mean()) < tolerance
    assert SIGMA_RATIO[0] < np.sqrt(((error / code.sigma_px[:, None]) ** 2).mean()) < SIGMA_RATIO[1]
    step = 0.5
    for axis, shift in enumerate(([step, 0], [0, step])):
        x = np.column_stack([code.camera_px + shift, np.ones(len(code.index))]) @ H.T
        slope = (in_projector(x[:, :2] / x[:, 2:]) - true) / step
        assert np.abs(code.jacobian[:, :, axis] - slope).max() < SLOPE


def test_a_capture_with_one_axis_gives_the_camera_alone_and_says_so(tmp_path):
    coded_capture(tmp_path, phase_shift_sequence(PROJECTOR_PX))
    seen = observe_boards(tmp_path)
    assert seen.devices == ("A",)
    assert seen.views[0].code == ()
    assert seen.missed == {"01: code": "only the projector's axis u is encoded: u and v are needed"}


def test_without_a_white_image_the_mean_of_the_sequence_shows_the_board(tmp_path):
    fringes = [entry for entry in phase_shift_sequence(PROJECTOR_PX) if entry.role == "phase"]
    pixels = coded_capture(tmp_path, fringes)
    seen = observe_boards(tmp_path)
    points = seen.views[0].cameras["A"]
    assert seen.views[0].images == {"A": "01: mean of camera A"}
    errors = [np.abs(points.pixel_px - pixels[turn[points.index]]).max() for turn in names_alike(PRINTED)]
    assert min(errors) < 0.05


def test_a_capture_that_encodes_the_projector_must_state_its_size(tmp_path):
    sequence, _ = SEQUENCES["Gray code"]
    few = [next(e for e in sequence if axis_of(e) == axis and e.role == "gray") for axis in "uv"]
    coded_capture(tmp_path, [*few, *(e for e in sequence if e.role == "white")], projector_px=None)
    with pytest.raises(InputError, match="names no size of the projector"):
        observe_boards(tmp_path)


def test_a_mask_leaves_out_points_of_the_camera_and_of_the_code(tmp_path):
    pixels = coded_capture(tmp_path, SEQUENCES["fringes"][0], mask={"A": "mask.png"})
    mask = np.full((160, 200), 255, np.uint8)
    mask[:, : int(pixels[:, 0].min()) + 6] = 0
    cv2.imwrite(str(tmp_path / "01" / "mask.png"), mask)
    view = observe_boards(tmp_path).views[0]
    assert 12 <= len(view.cameras["A"].index) < 20
    assert set(view.code[0].index) <= set(view.cameras["A"].index)
    cv2.imwrite(str(tmp_path / "01" / "mask.png"), mask[:100])
    with pytest.raises(InputError, match=r"mask\.A: is 200 x 100 px"):
        observe_boards(tmp_path)
