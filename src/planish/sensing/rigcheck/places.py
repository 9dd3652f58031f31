"""Places of a measurement at which the row error is looked for."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.sensing.rigcheck.pairs import across_epipolar_lines, unit_rays

#: A tile is a square of so many pixels at least, and of about this share of the image's width.
MIN_SIDE_PX, SIDE_SHARE, SIDE_STEP_PX = 32, 1 / 32, 8
#: A tile counts where this share of it has correspondences.
MIN_SHARE = 0.9
#: Fewer places say nothing.
MIN_PLACES = 8
#: The direction of a fringe in the other image, as the tangent of its angle to the normal of the epipolar line, is
#: known to this standard deviation with and without decoded positions.
SLACK_KNOWN, SLACK_UNKNOWN = 0.1, 0.5
#: Fringes nearer to the epipolar lines than this (cosine to their normal) do not tell where a point is along them.
MIN_ACROSS = 0.3


@dataclass(frozen=True)
class Places:
    """Tiles of the organising camera with dense correspondences.

    Parameters
    ----------
    own, other : str
        The organising camera and the other one.
    side_px : int
        Side of a tile [px].
    corner_px : ndarray (n, 2) int
        First pixel (u, v) of each tile.
    pixel_px : ndarray (n, side, side, 2) float32
        Corresponding pixels in the other camera; NaN where there are none.
    center_px, there_px : ndarray (n, 2)
        A pixel near the tile's centre and its corresponding pixel.
    points_sensor : ndarray (n, 3)
        Point of that pixel [mm].
    affine : ndarray (n, 2, 2)
        Change of the corresponding pixel per pixel.
    across : ndarray (n, 2)
        Unit vector across the epipolar line in the other image.
    lean : ndarray (n,)
        Motion along the epipolar line, 90 degrees on from `across`, per motion across it of what moves along a fringe.
    slack : float
        Standard deviation of `lean`.
    """

    own: str
    other: str
    side_px: int
    corner_px: NDArray[np.int64]
    pixel_px: Map
    center_px: Array
    there_px: Array
    points_sensor: Array
    affine: Array
    across: Array
    lean: Array
    slack: float

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self.corner_px)

    @property
    def along(self) -> Array:
        """Unit vector (n, 2) along the epipolar line: `across`, turned by 90 degrees."""
        return np.stack([-self.across[:, 1], self.across[:, 0]], -1)

    def own_tiles(self, image: Map) -> Map:
        """Return the tiles (n, side, side) of an image of the organising camera."""
        side = self.side_px
        return np.stack([image[v : v + side, u : u + side] for u, v in self.corner_px]).astype(np.float32)

    def other_tiles(self, image: Map, shift_px: Array) -> Map:
        """Return an image of the other camera at the corresponding pixels, moved by `shift_px` (n, 2) [px]."""
        side = self.side_px
        at = (self.pixel_px + shift_px[:, None, None].astype(np.float32)).reshape(-1, side, 2)
        tiles = cv2.remap(image, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        return np.asarray(tiles.reshape(-1, side, side), np.float32)


def choose_places(measurement: Measurement) -> Places | None:
    """Return tiles all over the image, where correspondences are dense; None where there are too few.

    Parameters
    ----------
    measurement : Measurement
        With correspondences between two cameras.
    """
    own = measurement.organised_on
    other = measurement.rig.other(own)
    pixels = measurement.correspondence_px
    if other is None or pixels is None:
        return None
    side = tile_side(measurement.shape[1])
    known = np.isfinite(pixels[..., 0]) & measurement.valid
    position = measurement.position_px
    if position is not None:
        known &= np.isfinite(position)
    corners = tile_corners(known, side)
    if len(corners) < MIN_PLACES:
        return None
    parts = [
        _tile(measurement.points_sensor, pixels, position, known[v : v + side, u : u + side], u, v) for u, v in corners
    ]  # fmt: skip
    center, there, points, affine, gradient = (np.array(part, float) for part in zip(*parts, strict=True))
    rig = measurement.rig
    across, _ = across_epipolar_lines(rig.cameras[other], points, unit_rays(rig.cameras[own], center))
    lean, slack = _lean(affine, gradient, across)
    tiles = np.stack([pixels[v : v + side, u : u + side] for u, v in corners])
    return Places(
        own, other, side, np.array(corners), tiles, center, there, points, affine, across, lean, slack
    )  # fmt: skip


def tile_side(width: int) -> int:
    """Return the side of a tile [px] for images of this width."""
    return max(MIN_SIDE_PX, SIDE_STEP_PX * round(width * SIDE_SHARE / SIDE_STEP_PX))


def tile_corners(known: NDArray[np.bool_], side: int) -> list[tuple[int, int]]:
    """Return the first pixels (u, v) of the tiles of which nearly all is known (H, W)."""
    height, width = known.shape
    grid = ((u, v) for v in range(0, height - side + 1, side) for u in range(0, width - side + 1, side))
    return [(u, v) for u, v in grid if known[v : v + side, u : u + side].mean() >= MIN_SHARE]


def _tile(
    points: Map, pixels: Map, position: Map | None, known: NDArray[np.bool_], u: int, v: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Central pixel, its correspondence and point; derivatives of correspondence and position by the pixel."""
    rows, columns = np.nonzero(known)
    side = len(known)
    nearest = np.argmin((rows - side / 2) ** 2 + (columns - side / 2) ** 2)
    center = np.array([columns[nearest], rows[nearest]])
    plane = np.column_stack([columns - center[0], rows - center[1], np.ones(len(rows))])
    at = (rows + v, columns + u)
    decoded = np.zeros(len(rows)) if position is None else position[at]
    values = np.column_stack([pixels[at], points[at], decoded]).astype(float)
    fit = np.linalg.lstsq(plane, values, rcond=None)[0]
    # The correspondence of the plane, not of one pixel: that has noise.
    return center + [u, v], fit[2, :2], fit[2, 2:5], fit[:2, :2].T, fit[:2, 5]


def _lean(affine: Array, gradient: Array, across: Array) -> tuple[Array, float]:
    """Direction of the fringes in the other image, and how well it is known.

    Along a fringe the decoded position (gradient (n, 2) by the pixel) does not change, and corresponding pixels see the
    same position, whatever the rig: the fringe of the other image is that of the own one, mapped by `affine`.
    """
    if not gradient.any():
        return np.zeros(len(across)), SLACK_UNKNOWN
    image = np.einsum("nij,nj->ni", affine, np.stack([-gradient[:, 1], gradient[:, 0]], -1))
    image /= np.maximum(np.linalg.norm(image, axis=1, keepdims=True), 1e-12)
    on = (image * across).sum(1)
    along = image[:, 1] * across[:, 0] - image[:, 0] * across[:, 1]
    return along / np.where(np.abs(on) < MIN_ACROSS, np.copysign(MIN_ACROSS, on), on), SLACK_KNOWN
