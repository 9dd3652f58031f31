"""Start values of one device: focal length from the homographies of its views, places of the board in its frame."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from planish.geometry import Array, compose, exp_so3
from planish.rig import Camera
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.problem import Block, Mask

#: Focal lengths tried, as shares of the image's longer side, and how many.
FOCAL_RANGE, FOCAL_STEPS = (0.3, 20.0), 90
#: Heights of the principal point tried for projectors (shares of the image's height): they look upwards or downwards.
PROJECTOR_HEIGHTS = np.linspace(-1.0, 2.0, 13)
#: Relation of the pixels' sides tried for projectors: mirrors on a diamond grid have half the columns or rows.
PROJECTOR_ASPECTS = (1.0, 2.0, 0.5)
#: By so much the homographies of a lens with distortion contradict a pinhole.
HOMOGRAPHY_ERROR = 0.02
#: Points farther from a homography than so many robust standard deviations, and this share of the image, are left out.
HOMOGRAPHY_SIGMAS, HOMOGRAPHY_SHARE = 5.0, 0.002


def start_camera(block: Block, points_board: Array, size_px: tuple[int, int]) -> Camera:
    """Return a pinhole whose focal length makes the images of the board most nearly those of a plane.

    Notes
    -----
    The columns of K^-1 H = [r1 r2 t] are orthogonal and of one length (Zhang, A flexible new technique for camera
    calibration, PAMI 2000, eq. 3-4). A search over the focal length needs no start, and the robust sum over the views
    lets single ones be wrong.
    """
    H = homographies(block, points_board)
    heights, aspects = (PROJECTOR_HEIGHTS, PROJECTOR_ASPECTS) if block.device == PROJECTOR else ((0.5,), (1.0,))
    best: tuple[float, float, float, float] = (np.inf, float(max(size_px)), 1.0, 0.5)
    for aspect in aspects:
        for height in heights:
            for focal in np.geomspace(*FOCAL_RANGE, FOCAL_STEPS) * max(size_px):
                n = H.copy()
                n[:, 0] = (H[:, 0] - (size_px[0] - 1) / 2 * H[:, 2]) / focal
                n[:, 1] = (H[:, 1] - ((size_px[1] * height) - 0.5) * H[:, 2]) / (focal * aspect)
                best = min(best, (_contradiction(n), focal, aspect, height))
    _, focal, aspect, height = best
    K = np.array([[focal, 0, (size_px[0] - 1) / 2], [0, focal * aspect, size_px[1] * height - 0.5], [0, 0, 1.0]])
    return Camera.make(K, (), size_px, np.eye(4), block.device)


def _contradiction(n: Array) -> float:
    a, b = n[:, :, 0], n[:, :, 1]
    la, lb = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    error = ((a * b).sum(1) / (la * lb)) ** 2 + np.log(la / lb) ** 2
    return float(np.log1p(error / HOMOGRAPHY_ERROR**2).sum())


def homographies(block: Block, points_board: Array) -> Array:
    """Return the homographies (R, 3, 3) from the board's plane to pixels of the views that the device sees."""
    found = []
    for v in np.flatnonzero(block.views):
        seen = np.flatnonzero(block.seen[v])
        flat, pixel = points_board[seen, :2], block.observed_px[v, seen]
        H = _homography(flat, pixel)
        away = np.linalg.norm(_apply(H, flat) - pixel, axis=1)
        span = float(np.ptp(pixel, axis=0).max())
        good = away <= max(HOMOGRAPHY_SIGMAS * float(np.median(away)), HOMOGRAPHY_SHARE * span)
        if not good.all() and good.sum() >= 2 * len(good) / 3:
            H = _homography(flat[good], pixel[good])
        found.append(H)
    return np.array(found)


def _homography(flat: Array, pixel: Array) -> Array:
    H, _ = cv2.findHomography(flat, pixel)
    return np.asarray(H, np.float64)


def _apply(H: Array, flat: Array) -> Array:
    x = np.column_stack([flat, np.ones(len(flat))]) @ H.T
    return x[:, :2] / x[:, 2:]


def place_boards(block: Block, points_board: Array, camera: Camera, views: Mask) -> Array:
    """Return T_device_board (V, 4, 4) of the views (V,) as one device sees them, NaN elsewhere.

    A plane seen from afar has two places that differ little in the image; the one of the smaller error is taken.
    """
    places = np.full((len(block.sigma_px), 4, 4), np.nan)
    for v in np.flatnonzero(views & block.views):
        places[v] = _place(block, points_board, camera, int(v))
    return places


def upside_down(block: Block, camera: Camera) -> Block:
    """Return the block as if its images were turned by 180 degrees."""
    return replace(block, observed_px=np.array(camera.size_px) - 1.0 - block.observed_px)


def place_errors(block: Block, points_board: Array, camera: Camera, T_device_board: Array) -> Array:
    """Return the median error [px] of each view (V,) with the board at these places; NaN where there is none."""
    own = Camera(camera.K, camera.distortion, camera.size_px, np.eye(4))
    points = points_board @ T_device_board[:, :3, :3].swapaxes(1, 2) + T_device_board[:, None, :3, 3]
    away = np.where(block.seen, np.linalg.norm(own.project(points) - block.observed_px, axis=-1), np.nan)
    errors = np.full(len(away), np.nan)
    known = np.isfinite(away).any(1)
    errors[known] = np.nanmedian(away[known], axis=1)
    return errors


def _place(block: Block, points_board: Array, camera: Camera, view: int) -> Array:
    seen = np.flatnonzero(block.seen[view])
    own = Camera(camera.K, camera.distortion, camera.size_px, np.eye(4))
    direction = own.rays_sensor(block.observed_px[view, seen])
    inside = np.isfinite(direction).all(1)
    if inside.sum() < 4:
        return np.full((4, 4), np.nan)
    # The method wants the points about the origin.
    middle = points_board[seen].mean(0)
    local = points_board[seen[inside]] - middle
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        local, direction[inside, :2], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    best, least = np.full((4, 4), np.nan), np.inf
    for rotation, shift in zip(rotations, translations, strict=True):
        T = compose(exp_so3(rotation.ravel()), shift.ravel())
        error = np.median(
            np.linalg.norm(own.project(local @ T[:3, :3].T + T[:3, 3]) - block.observed_px[view, seen[inside]], axis=1)
        )
        if error < least:
            T[:3, 3] -= T[:3, :3] @ middle
            best, least = T, float(error)
    return best
