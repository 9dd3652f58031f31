"""A flat chessboard in three positions, one camera and one projector, Gray code alone.

The calibration is in units of which a square of the board measures 75, with cells of two projector pixels: only so do
both axes agree, and the squares come out right. Its author states a reprojection error of 0.86 px.
"""

import cv2
import numpy as np
import pytest
from captures import load

from planish.pipeline import measure
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.decode import PhaseMap
from planish.sensing.decode.gray import gray_positions
from planish.sensing.points.projector import intersect
from spread import robust_spread

CORNERS, SQUARE = (9, 7), 75.0
WHITE, BLACK, LIT_LEVELS = 40, 41, 20
CELL_PX = 2.0
#: Seen with cell centres: 0.67, 0.64, 0.68 px of the projector. Quantisation alone is 2 / sqrt(12) = 0.58.
PLAIN_PX = 0.70
#: The same rms in units of the board: 3.4, 1.35, 2.15; with sub-pixel edges 1.77, 0.50, 1.04.
EDGES_UNITS = (1.9, 0.6, 1.15)


def board(capture):
    """Mask (H, W) of the board between its outermost inner corners, and these corners (7, 9, 2)."""
    white, black = (capture.read_image("A", k).astype(float) for k in (WHITE, BLACK))
    found, corners = cv2.findChessboardCorners(white.astype(np.uint8), CORNERS)
    assert found
    mask = np.zeros(white.shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(corners.reshape(-1, 2).round().astype(np.int32)), 1)
    return (mask > 0) & (white - black > LIT_LEVELS), corners.reshape(CORNERS[1], CORNERS[0], 2)


def cell_centres(capture, mask):
    """What a plain decoder has: the points of the cells' centres, where camera and projector see them."""
    rig, images = capture.load_rig("A"), capture.read_images("A", 2)
    (layout,) = read_layouts(capture.manifest, "capture.json", rig.projector.size_px)
    phases = {}
    for code in layout.codes:
        position = np.where(mask, gray_positions(images, code, layout, 2), np.nan).astype(np.float32)
        sigma = np.full(position.shape, CELL_PX / np.sqrt(12), np.float32)
        phases[code.axis] = PhaseMap(code.axis, position, sigma, np.zeros(position.shape, np.uint16))
    return intersect(phases, "v", rig.cameras["A"], rig.projector, 2)


def fit_plane(points):
    """Point and normal of the plane, and distances of points (N, 3); fitted without outliers."""
    use = np.ones(len(points), bool)
    for _ in range(5):
        center = points[use].mean(0)
        normal = np.linalg.svd((points[use] - center)[::7], full_matrices=False)[2][2]
        distance = (points - center) @ normal
        use = np.abs(distance) < 4 * robust_spread(distance)
    return center, normal, distance, use


@pytest.mark.parametrize("index", [0, 1, 2])
def test_cell_centres_lie_on_the_board_within_their_quantisation(index):
    capture = load("procam_board", f"capture_{index}.json")
    rig = capture.load_rig("A")
    mask, corners = board(capture)
    found = cell_centres(capture, mask)
    known = np.isfinite(found.sigma_mm)
    assert known.sum() > 0.99 * mask.sum()
    points = found.points_sensor[known].astype(float)
    center, normal, distance, use = fit_plane(points)
    along = distance / (points @ normal) * np.linalg.norm(points, axis=1)
    residual_px = along / found.sigma_mm[known] * CELL_PX / np.sqrt(12)
    assert np.std(residual_px[use]) < PLAIN_PX
    rays = rig.cameras["A"].rays_sensor(corners)
    on_board = rays * ((center @ normal) / (rays @ normal))[..., None]
    sides = [np.linalg.norm(np.diff(on_board, axis=axis), axis=-1).mean() for axis in (0, 1)]
    assert sides == pytest.approx([SQUARE, SQUARE], rel=0.04)


@pytest.mark.parametrize("index", [0, 1, 2])
def test_edges_between_the_pixels_lie_nearer_to_the_plane(index):
    capture = load("procam_board", f"capture_{index}.json")
    m = measure(capture, None, 2)
    use = board(capture)[0] & m.valid
    assert use.sum() > 50_000
    _, _, distance, inliers = fit_plane(m.points_sensor[use].astype(float))
    assert np.std(distance[inliers]) < EDGES_UNITS[index]


def test_the_calibration_is_found_to_contradict_itself_away_from_the_board():
    m = measure(load("procam_board", "capture_1.json"), None, 2)
    finding = next(f for f in m.findings if f.quantity == "row error against the projector")
    assert finding.value > 1.0
    assert "calibrate again" in finding.warning
