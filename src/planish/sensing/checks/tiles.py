"""Places of the image, and what they say together about the error across the epipolar lines."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map
from planish.rig import Camera
from planish.sensing.points.triangulate import TriangulatedPoints

#: An error (or its variation over the image) above this is worth a warning [px] ...
WARN_PX = 0.5
#: ... where it exceeds this many standard deviations.
WARN_SIGMAS = 5.0
#: Side of a tile [px] and number of tiles across and down the image.
TILE_PX, TILES = 32, (7, 5)
#: A tile counts where this share of it has correspondences.
TILE_SHARE = 0.95
#: Fewer tiles say nothing.
MIN_TILES = 4
#: A wrong rig makes an error that varies smoothly: tiles this far from a plane through all [px, standard deviations]
#: have seen something else, and where more than this share do, nothing is known.
OFF_PLANE_PX, OFF_PLANE_SIGMAS, MAX_OFF_SHARE = 0.5, 5.0, 0.4
#: Iterations of the least absolute deviations (iteratively reweighted).
PLANE_ITERATIONS = 12
#: Step along the ray that shows the direction of the epipolar line, as a share of the distance.
RAY_STEP = 0.01


@dataclass(frozen=True)
class Tiles:
    """Places where the row error is looked for.

    Parameters
    ----------
    corner_px : ndarray (n, 2) int
        First pixel (u, v) of each tile in the organising camera.
    pixel_px : ndarray (n, TILE_PX, TILE_PX, 2) float32
        Corresponding pixels in the other camera.
    across : ndarray (n, 2) float32
        Unit vector across the epipolar line in the other image, towards larger v (larger u where lines stand upright).
    """

    corner_px: NDArray[np.int64]
    pixel_px: Map
    across: Map

    def own(self, image: Map) -> Map:
        """Return the tiles (n, TILE_PX, TILE_PX) of an image of the organising camera."""
        return np.stack([image[v : v + TILE_PX, u : u + TILE_PX] for u, v in self.corner_px]).astype(np.float32)

    def other(self, image: Map, shift_px: float | Array) -> Map:
        """Return an image of the other camera at the corresponding pixels, moved across the epipolar lines."""
        move = np.broadcast_to(np.asarray(shift_px, np.float32), len(self.across))[:, None] * self.across
        at = (self.pixel_px + move[:, None, None]).reshape(-1, TILE_PX, 2)
        sampled = cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        return np.asarray(sampled.reshape(-1, TILE_PX, TILE_PX), np.float32)


@dataclass(frozen=True)
class RowError:
    """Row errors of tiles [px of the other camera], positive in the direction of `across`.

    Parameters
    ----------
    value_px, sigma_px : ndarray (n,)
        Of the tiles where it is observable.
    searched : int
        Number of tiles that were looked at.
    """

    value_px: Array
    sigma_px: Array
    searched: int

    @property
    def observable(self) -> bool:
        """Whether enough tiles tell."""
        return len(self.value_px) >= MIN_TILES

    def smooth(self, corner_px: NDArray[np.int64]) -> RowError:
        """Return the tiles that lie on a plane over the image, (n, 2) their places; none where too many do not."""
        none = RowError(np.empty(0), np.empty(0), self.searched)
        if not self.observable:
            return none
        places = (corner_px - corner_px.mean(0)) / max(float(np.ptp(corner_px)), 1.0)
        plane = np.column_stack([np.ones(len(places)), places])
        weight = np.ones(len(places))
        for _ in range(PLANE_ITERATIONS):
            x = np.linalg.lstsq(plane * weight[:, None], self.value_px * weight, rcond=None)[0]
            left = np.abs(self.value_px - plane @ x)
            weight = 1 / np.sqrt(np.maximum(left, 0.05))
        near = left < np.maximum(OFF_PLANE_PX, OFF_PLANE_SIGMAS * self.sigma_px)
        if near.mean() < 1 - MAX_OFF_SHARE:
            return none
        return RowError(self.value_px[near], self.sigma_px[near], self.searched)

    @property
    def median_px(self) -> float:
        """Typical row error."""
        return float(np.median(self.value_px))

    @property
    def spread_px(self) -> float:
        """Robust standard deviation over the tiles."""
        return float(1.4826 * np.median(np.abs(self.value_px - self.median_px)))

    @property
    def sigma_median_px(self) -> float:
        """Standard deviation of the median: 1.25 times that of a mean."""
        each = max(float(np.sqrt(np.mean(self.sigma_px**2))), self.spread_px)
        return 1.2533 * each / float(np.sqrt(len(self.value_px)))

    @property
    def bad(self) -> bool:
        """Whether value or variation is too large, beyond doubt."""
        if not self.observable:
            return False
        value = abs(self.median_px) > max(WARN_PX, WARN_SIGMAS * self.sigma_median_px)
        typical = float(np.median(self.sigma_px))
        return bool(value or self.spread_px > max(WARN_PX, WARN_SIGMAS * typical))


def choose_tiles(pixel_px: Map, found: TriangulatedPoints, own: Camera, other: Camera) -> Tiles | None:
    """Return tiles evenly spread where correspondences are dense, or None where there are none."""
    height, width = pixel_px.shape[:2]
    corners, pixels, centres = [], [], []
    for v in np.linspace(0, height - TILE_PX, TILES[1] + 2)[1:-1].astype(int):
        for u in np.linspace(0, width - TILE_PX, TILES[0] + 2)[1:-1].astype(int):
            tile = pixel_px[v : v + TILE_PX, u : u + TILE_PX]
            point = found.points_sensor[v + TILE_PX // 2, u + TILE_PX // 2]
            if tile.shape[:2] != (TILE_PX, TILE_PX) or not np.isfinite(point).all():
                continue
            if np.isfinite(tile[..., 0]).mean() >= TILE_SHARE:
                corners.append((u, v))
                pixels.append(tile)
                centres.append(point)
    if len(corners) < MIN_TILES:
        return None
    points = np.array(centres, float)
    along = other.project(points + RAY_STEP * (points - own.center_sensor)) - other.project(points)
    across = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=1, keepdims=True)
    main = 1 if np.abs(across[:, 1]).mean() > np.abs(across[:, 0]).mean() else 0
    across *= np.sign(across[:, main : main + 1])
    return Tiles(np.array(corners), np.array(pixels, np.float32), across.astype(np.float32))
