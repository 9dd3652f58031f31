"""Images of boards drawn by NumPy alone, with the true place of every point: what detection is judged by."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter

from planish.geometry import Array, exp_so3
from planish.rig import Camera
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Chessboard, board_points

#: Grey levels of ink and paper.
INK, PAPER = 30.0, 180.0
#: Grey level where a projector shows nothing.
UNLIT = 8.0
#: Pixels of the ChArUco artwork per square.
ARTWORK_PX = 400


def looking_down(size_px=(400, 300), focal_px=900.0, distortion=()) -> Camera:
    """A camera whose sensor frame is its own."""
    K = [[focal_px, 0, size_px[0] / 2 - 0.5], [0, focal_px, size_px[1] / 2 - 0.5], [0, 0, 1]]
    return Camera.make(K, distortion, size_px, np.eye(4))


def placed(board: Board, camera: Camera, rotation_rad=(0.0, 0.0, 0.0), fill=0.75, shift=(0.0, 0.0)) -> Array:
    """T_camera_board with the board's middle on the optical axis, turned, filling `fill` of the image."""
    points = board_points(board)
    low, high = points.min(0), points.max(0)
    margin = 2 * max(board.pitches_mm)
    distance = max((high - low + margin)[:2] * camera.K[[0, 1], [0, 1]] / camera.size_px) / fill
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.asarray(rotation_rad, float))
    T[:3, 3] = (*(np.asarray(shift) * distance), distance) - T[:3, :3] @ ((low + high) / 2)
    return T


def reflectance(board: Board, x, y, sample_mm):
    """Where paper shows, 0 ... 1, at points (x, y) [mm] of the board's frame, averaged over samples of `sample_mm`."""
    px, py = board.pitches_mm
    columns, rows = board.grid
    if isinstance(board, Chessboard):
        i, j = np.floor(x / px), np.floor(y / py)
        inside = (i >= -1) & (i < columns) & (j >= -1) & (j < rows)
        # Edges that a sample straddles are covered in part: +1 within a square, -1 in its neighbours.
        return np.where(inside, 0.5 - 0.5 * _side(x, px, sample_mm) * _side(y, py, sample_mm), 1.0)
    if isinstance(board, Charuco):
        return _charuco(board, x, y)
    diameter = board.diameter_mm or 0.5 * px
    out = np.ones_like(x)
    for odd in (0, 1) if isinstance(board, AsymmetricCircles) else (0,):
        step = 2 if isinstance(board, AsymmetricCircles) else 1
        last = ((columns - 1) * step + odd, rows - 1 - (rows - 1 - odd) % step)
        i = (step * np.round((x / px - odd) / step) + odd).clip(odd, last[0])
        j = (step * np.round((y / py - odd) / step) + odd).clip(odd, last[1])
        distance = np.hypot(x - i * px, y - j * py) - diameter / 2
        out = np.minimum(out, np.clip(0.5 + distance / sample_mm, 0, 1))
    return out


def _side(x, pitch, sample_mm):
    """+1 in even strips of width `pitch`, -1 in odd ones, and what lies between in samples on their borders."""
    border = np.round(x / pitch)
    return np.where(border % 2 == 0, 1, -1) * np.clip(2 * (x - border * pitch) / sample_mm, -1, 1)


def _charuco(board: Charuco, x, y):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    pitch = board.pitches_mm[0]
    made = cv2.aruco.CharucoBoard(board.squares, pitch, board.marker_mm, dictionary)
    made.setLegacyPattern(board.legacy)
    size = (board.squares[0] * ARTWORK_PX, board.squares[1] * ARTWORK_PX)
    artwork = made.generateImage(size, marginSize=0) / 255.0
    # The board's first point is the first inner corner, a square from the artwork's corner.
    u, v = (x / pitch + 1) * ARTWORK_PX, (y / pitch + 1) * ARTWORK_PX
    inside = (u >= 0) & (v >= 0) & (u < size[0]) & (v < size[1])
    values = artwork[v.clip(0, size[1] - 1).astype(int), u.clip(0, size[0] - 1).astype(int)]
    return np.where(inside, values, 1.0)


def draw(
    board,
    camera,
    T_camera_board,
    *,
    blur_px=0.7,
    noise=0.0,
    seed=0,
    bits=8,
    supersampling=8,
    light=False,
    lit=None,
    paper_mm=None,
):
    """The image (H, W), uint8, uint16 or (bits = 0) float, and the true pixels (N, 2) of the board's points.

    Parameters
    ----------
    blur_px : float
        Standard deviation of the lens's blur; a pixel's own width comes to it [px].
    noise : float
        Standard deviation of a grey value of 255.
    light : bool
        Light figures on dark ground.
    lit : callable or None
        Light, 0 ... 1, at points (x, y) [mm] of the board: what a projector shows there. Default: everywhere 1.
    paper_mm : float or None
        The board ends so far beyond its outermost points; behind it, it is dark.
    """
    width, height = camera.size_px
    fine = (
        (np.arange(width * supersampling) + 0.5) / supersampling - 0.5,
        (np.arange(height * supersampling) + 0.5) / supersampling - 0.5,
    )
    x, y = _on_board(camera, T_camera_board, *np.meshgrid(*fine))
    sample_mm = np.sqrt(
        np.abs(np.gradient(x, axis=1) * np.gradient(y, axis=0) - np.gradient(x, axis=0) * np.gradient(y, axis=1))
    )
    shown = reflectance(board, x, y, sample_mm)
    if light:
        shown = 1 - shown
    if paper_mm is not None:
        last = board_points(board).max(0)
        beyond = np.maximum(np.abs(x - last[0] / 2) - last[0] / 2, np.abs(y - last[1] / 2) - last[1] / 2)
        shown[beyond > paper_mm] = 0
    shown = INK / PAPER + (1 - INK / PAPER) * shown
    if lit is not None:
        shown = shown * lit(x, y)
    shown = gaussian_filter(shown, blur_px * supersampling, truncate=4)
    shown = shown.reshape(height, supersampling, width, supersampling).mean((1, 3))
    grey = PAPER * shown if lit is None else UNLIT + (PAPER - UNLIT) * shown
    rng = np.random.default_rng(seed)
    grey = grey + noise * rng.standard_normal(grey.shape)
    points = board_points(board) @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    truth = camera.project(points)
    if bits == 0:
        return grey, truth
    scale = 1 if bits == 8 else 256
    return np.clip(np.round(grey * scale), 0, 256 * scale - 1).astype(np.uint8 if bits == 8 else np.uint16), truth


def _on_board(camera: Camera, T_camera_board, u, v):
    if np.any(camera.distortion):
        # The inverse distortion is smooth: from every fourth pixel to all samples by splines.
        nodes = [np.arange(axis.min() - 6, axis.max() + 6, 4.0) for axis in (v, u)]
        coarse = camera.rays_sensor(np.stack(np.meshgrid(*nodes, indexing="ij")[::-1], -1))
        splines = [RectBivariateSpline(*nodes, coarse[..., k]) for k in range(3)]
        rays = np.stack([spline(v[:, 0], u[0]) for spline in splines], -1)
    else:
        rays = np.stack(
            [(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(u)], -1
        )
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    direction, origin = rays @ R, -t @ R
    along = -origin[2] / direction[..., 2]
    return origin[0] + along * direction[..., 0], origin[1] + along * direction[..., 1]


def disc_centers(board, camera, T_camera_board) -> Array:
    """Centres (N, 2) of the discs' images [px]: ellipses, whose centres are not the images of the discs' centres."""
    x, y = board_points(board)[:, 0], board_points(board)[:, 1]
    radius = (board.diameter_mm or 0.5 * board.pitches_mm[0]) / 2
    H = camera.K @ np.column_stack([T_camera_board[:3, :2], T_camera_board[:3, 3]])
    centers = []
    for a, b in zip(x, y, strict=True):
        # Points of the circle's conic C go to H^-T C H^-1; its centre is the pole of the line at infinity.
        C = np.array([[1, 0, -a], [0, 1, -b], [-a, -b, a * a + b * b - radius**2]])
        image = np.linalg.inv(H).T @ C @ np.linalg.inv(H)
        pole = np.linalg.solve(image, [0, 0, 1])
        centers.append(pole[:2] / pole[2])
    return np.array(centers)
