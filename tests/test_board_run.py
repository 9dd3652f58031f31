"""Board runs: from files to observations, and what is said of files that are no good."""

import json

import cv2
import numpy as np
import pytest

from drawn_boards import draw, looking_down, placed
from planish.errors import InputError
from planish.sensing.calibrate.boards.agree import agree
from planish.sensing.calibrate.boards.label import renamed
from planish.sensing.calibrate.boards.manifest import load_run
from planish.sensing.calibrate.boards.observe import observe_boards
from planish.sensing.calibrate.observations import BoardPoints
from planish.sensing.calibrate.symmetry import names_alike
from planish.sensing.capture.board import board_points, parse_board

BOARD = {"schema": "planish.board/1", "kind": "chessboard", "corners": [5, 3], "pitch_mm": 10}
PRINTED = parse_board(BOARD, "board.json")
#: Camera B beside camera A, turned towards the board.
T_B_A = np.array([[0.96, 0, 0.28, -20], [0, 1, 0, 1], [-0.28, 0, 0.96, 5], [0, 0, 0, 1]], float)
TILTS = ((0.3, -0.2, 0.1), (-0.2, 0.35, 0.05), (0.1, 0.25, 0.2), (-0.3, -0.25, -0.15))


def camera():
    return looking_down((200, 150), 450.0)


def drawn(tilt, printed=PRINTED, turned_by=None, **options):
    T = placed(printed, camera(), tilt, fill=0.7)
    # Camera B looks at the point that camera A looks at, from the side.
    T_seen = T.copy()
    if turned_by is not None:
        middle = board_points(printed).mean(0)
        distance = (T[:3, :3] @ middle + T[:3, 3])[2]
        T_seen[:3, :3] = turned_by[:3, :3] @ T[:3, :3]
        T_seen[:3, 3] = [0, 0, distance] - T_seen[:3, :3] @ middle
    return draw(printed, camera(), T_seen, supersampling=2, noise=1, **options)


@pytest.fixture(scope="module")
def images():
    return {c: [drawn(t, turned_by=T)[0] for t in TILTS] for c, T in (("A", None), ("B", T_B_A))}


def write(folder, images, names=None, board=BOARD):
    for c, stack in images.items():
        (folder / c).mkdir(parents=True)
        for k, image in enumerate(stack):
            name = f"{k}.png" if names is None else names[c][k]
            cv2.imwrite(str(folder / c / name), image)
    if board is not None:
        (folder / "board.json").write_text(json.dumps(board))
    return folder


def test_a_folder_of_two_cameras_is_paired_by_names(tmp_path, images):
    told = []
    seen = observe_boards(write(tmp_path, images), threads=2, progress=lambda *item: told.append(item))
    assert [view.name for view in seen.views] == ["0", "1", "2", "3"]
    assert seen.devices == ("A", "B")
    assert seen.size_px == {"A": (200, 150), "B": (200, 150)}
    assert seen.missed == {}
    assert seen.views[0].images == {"A": "A/0.png", "B": "B/0.png"}
    assert all(len(points.index) == 15 for view in seen.views for points in view.cameras.values())
    assert [done for _, done, _ in told] == list(range(1, 9))
    assert {total for *_, total in told} == {8}


def test_points_do_not_depend_on_the_number_of_threads(tmp_path, images):
    write(tmp_path, images)
    one, two = (observe_boards(tmp_path, threads=threads) for threads in (1, 2))
    for a, b in zip(one.views, two.views, strict=True):
        for name in "AB":
            assert a.cameras[name].pixel_px.tobytes() == b.cameras[name].pixel_px.tobytes()


def test_a_manifest_names_views_of_one_and_of_two_cameras(tmp_path, images):
    write(tmp_path, images, board=None)
    views = [{"name": "first", "A": "A/0.png", "B": "B/0.png"}, {"name": "second", "A": "A/1.png"}]
    content = {"schema": "planish.boards/1", "board": BOARD, "views": views}
    (tmp_path / "boards.json").write_text(json.dumps(content))
    seen = observe_boards(tmp_path)
    assert [sorted(view.cameras) for view in seen.views] == [["A", "B"], ["A"]]
    elsewhere = tmp_path / "manifest"
    elsewhere.mkdir()
    (elsewhere / "run.json").write_text(json.dumps(content))
    assert len(observe_boards(elsewhere / "run.json", images_dir=tmp_path).views) == 2


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (["left_0.png", "left_1.png"], ["right_0.png", "right_1.png"]),
        (["left01.png", "left02.png"], ["right01.png", "right02.png"]),
        (["0-cam0.png", "1-cam0.png"], ["0-cam1.png", "1-cam1.png"]),
        (["L_7.png", "L_9.png"], ["R_7.png", "R_9.png"]),
    ],
)
def test_a_word_for_the_camera_may_differ(tmp_path, images, a, b):
    write(tmp_path, {c: images[c][:2] for c in "AB"}, {"A": a, "B": b})
    run = load_run(tmp_path)
    assert [(v.images["A"].name, v.images["B"].name) for v in run.views] == list(zip(a, b, strict=True))


def test_unpaired_images_are_named(tmp_path, images):
    names = {"A": ["0.png", "1.png", "2.png", "3.png"], "B": ["0.png", "1.png", "3.png"]}
    write(tmp_path, {"A": images["A"], "B": images["B"][:3]}, names)
    with pytest.raises(InputError, match=r"4 images in A and 3 in B; without a partner: A/2\.png;"):
        load_run(tmp_path)


def test_as_many_images_of_other_names_are_not_paired_by_order(tmp_path, images):
    names = {"A": ["0.png", "1.png"], "B": ["5.png", "6.png"]}
    write(tmp_path, {c: images[c][:2] for c in "AB"}, names)
    with pytest.raises(InputError, match=r"without a partner: A/0\.png, A/1\.png, B/5\.png, B/6\.png"):
        load_run(tmp_path)


def test_an_image_without_a_board_is_named_and_the_rest_is_used(tmp_path, images):
    broken = {"A": images["A"], "B": [np.full((150, 200), 2, np.uint8), *images["B"][1:]]}
    seen = observe_boards(write(tmp_path, broken))
    assert list(seen.missed) == ["B/0.png"]
    assert "too dark" in seen.missed["B/0.png"]
    assert [sorted(view.cameras) for view in seen.views] == [["A"], ["A", "B"], ["A", "B"], ["A", "B"]]


def test_an_image_upside_down_is_found(tmp_path, images):
    turned = {"A": images["A"], "B": [images["B"][0][::-1, ::-1], *images["B"][1:]]}
    seen = observe_boards(write(tmp_path, turned))
    upright = observe_boards(write(tmp_path / "upright", images))
    there, here = (run.views[0].cameras["B"] for run in (upright, seen))
    errors = [np.abs(here.pixel_px + there.pixel_px[turn] - [199, 149]).max() for turn in names_alike(PRINTED)]
    assert min(errors) < 0.02


@pytest.mark.parametrize("depth", ["sixteen bits", "colour"])
def test_images_of_sixteen_bits_are_read_and_colour_is_refused(tmp_path, images, depth):
    image = images["A"][0]
    other = image.astype(np.uint16) * 16 if depth == "sixteen bits" else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    write(tmp_path, {"A": [other]})
    if depth == "sixteen bits":
        assert len(observe_boards(tmp_path).views[0].cameras["A"].index) == 15
    else:
        with pytest.raises(InputError, match=r"0\.png: is 200 x 150 px, 8 bit, 3 channels; expected a grey image"):
            observe_boards(tmp_path)


def test_mixed_sizes_are_refused(tmp_path, images):
    write(tmp_path, {"A": [images["A"][0], images["A"][1][:140]]})
    with pytest.raises(InputError, match=r"A/1\.png: is 200 x 140 px; expected 200 x 150 px, as A/0\.png"):
        observe_boards(tmp_path)


def test_an_unreadable_image_is_named(tmp_path, images):
    write(tmp_path, {"A": images["A"]})
    (tmp_path / "A" / "2.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"A/2\.png: cannot be decoded"):
        observe_boards(tmp_path)


def test_what_a_folder_lacks_is_said(tmp_path, images):
    with pytest.raises(InputError, match="holds no images of a board"):
        load_run(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        load_run(tmp_path / "nowhere")
    write(tmp_path, images, board=None)
    with pytest.raises(InputError, match=r"holds no board\.json"):
        load_run(tmp_path)
    assert load_run(tmp_path, PRINTED).board == PRINTED


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extra": 1}, "unknown key 'extra'"),
        ({"views": [{"name": "0", "A": "../A/0.png"}]}, "leaves the folder"),
        ({"views": [{"name": "0"}]}, "give images 'A', 'B' or both, or a 'capture'"),
        ({"views": [{"name": "0", "A": "A/0.png"}] * 2}, "several views are called 0"),
        ({"views": []}, "'views'"),
        ({"board": "../board.json"}, "leaves the folder"),
        ({"board": {**BOARD, "kind": "dots"}}, "'dots'"),
    ],
)
def test_a_manifest_is_checked(tmp_path, images, change, message):
    write(tmp_path, {"A": images["A"][:1]}, board=None)
    content = {"schema": "planish.boards/1", "board": BOARD, "views": [{"name": "0", "A": "A/0.png"}], **change}
    (tmp_path / "boards.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        load_run(tmp_path)


@pytest.mark.parametrize(
    ("printed", "stated", "message"),
    [
        (BOARD, {**BOARD, "corners": [8, 6]}, "a whole chessboard of 5 x 3 inner corners would fit"),
        (
            {"schema": "planish.board/1", "kind": "charuco", "squares": [5, 4], "marker_mm": 7, "pitch_mm": 10},
            {"legacy": True},
            "5 x 4 squares with markers of 4X4_50 would fit",
        ),
        (
            {"schema": "planish.board/1", "kind": "charuco", "squares": [5, 4], "marker_mm": 7, "pitch_mm": 10},
            {"dictionary": "6X6_50"},
            "with markers of 4X4_50 would fit",
        ),
        (
            {"schema": "planish.board/1", "kind": "circles", "circles": [6, 4], "pitch_mm": 10},
            {"circles": [7, 5]},
            "a whole grid of 6 x 4 discs would fit",
        ),
    ],
)
def test_a_board_that_would_fit_is_named(tmp_path, printed, stated, message):
    image, _ = drawn((0.2, -0.1, 0.1), parse_board(printed, "board.json"))
    write(tmp_path, {"A": [image]}, board={**printed, **stated})
    with pytest.raises(InputError, match=f"no board in any of 1 images .*expected .*{message}"):
        observe_boards(tmp_path)


@pytest.mark.parametrize("corners", [[5, 3], [5, 5]])
def test_both_cameras_get_the_same_names(corners):
    printed = parse_board({**BOARD, "corners": corners}, "board.json")
    assert len(names_alike(printed)) > 1
    rng = np.random.default_rng(1)
    views, truth = [], []
    for tilt in TILTS:
        view = {}
        for name, T in (("A", np.eye(4)), ("B", T_B_A)):
            T_seen = placed(printed, camera(), tilt, fill=0.7)
            T_seen[:3, :3] = T[:3, :3] @ T_seen[:3, :3]
            pixels = camera().project(board_points(printed) @ T_seen[:3, :3].T + T_seen[:3, 3])
            view[name] = BoardPoints(np.arange(len(pixels)), pixels, np.full(len(pixels), 0.05))
        truth.append(view["B"])
        wrong = names_alike(printed)[rng.integers(len(names_alike(printed)))]
        views.append({"A": view["A"], "B": renamed(view["B"], wrong)})
    found = agree(views, printed, {"A": (200, 150), "B": (200, 150)}, [None] * len(views))
    for view, turn, right in zip(views, found, truth, strict=True):
        assert renamed(view["B"], turn).pixel_px == pytest.approx(right.pixel_px)


def test_what_the_projector_says_names_the_points_of_both_cameras():
    points = camera().project(board_points(PRINTED) @ placed(PRINTED, camera())[:3, :3].T + [0, 0, 200])
    b = BoardPoints(np.arange(15), points, np.full(15, 0.05))
    turned = renamed(b, names_alike(PRINTED)[1])
    (turn,) = agree([{"A": b, "B": turned}], PRINTED, {"A": (200, 150), "B": (200, 150)}, [points + 0.4])
    assert renamed(turned, turn).pixel_px == pytest.approx(points)
