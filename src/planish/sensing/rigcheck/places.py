"""Places of a measurement at which the row error is looked for."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.rig import Camera, Rig
from planish.rig.derivatives import project_with_derivatives
from planish.sensing.rigcheck.pairs import across_epipolar_lines, unit_rays

#: A tile is a square of so many pixels at least, and of about this share of the image's width.
MIN_SIDE_PX, SIDE_SHARE, SIDE_STEP_PX = 32, 1 / 32, 8
#: A tile counts where this share of it has correspondences.
MIN_SHARE = 0.9
#: Fewer places say nothing.
MIN_PLACES = 8
#: The direction of a fringe in the other image, as the tangent of its angle to the normal of the epipolar line, is
#: known to this standard deviation with and without the projector's calibration.
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
    corners = tile_corners(known, side)
    if len(corners) < MIN_PLACES:
        return None
    parts = [
        _tile(measurement.points_sensor, pixels, known[v : v + side, u : u + side], u, v) for u, v in corners
    ]  # fmt: skip
    center, there, points, affine, tangents = (np.array(part, float) for part in zip(*parts, strict=True))
    rig = measurement.rig
    across, _ = across_epipolar_lines(rig.cameras[other], points, unit_rays(rig.cameras[own], center))
    lean, slack = _lean(rig, rig.cameras[other], points, tangents, across)
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


def _tile(points: Map, pixels: Map, known: NDArray[np.bool_], u: int, v: int) -> tuple[Array, ...]:
    """Central pixel, its correspondence and point; derivatives (2, 2) and (3, 2) of these by the pixel."""
    rows, columns = np.nonzero(known)
    side = len(known)
    nearest = np.argmin((rows - side / 2) ** 2 + (columns - side / 2) ** 2)
    center = np.array([columns[nearest], rows[nearest]])
    here = np.column_stack([columns - center[0], rows - center[1]])
    plane = np.column_stack([here, np.ones(len(here))])
    at = (rows + v, columns + u)
    values = np.column_stack([pixels[at], points[at]]).astype(float)
    fit = np.linalg.lstsq(plane, values, rcond=None)[0]
    # The correspondence of the plane, not of one pixel: that has noise.
    return center + [u, v], fit[2, :2], fit[2, 2:], fit[:2, :2].T, fit[:2, 2:].T


def _lean(rig: Rig, other: Camera, points: Array, tangents: Array, across: Array) -> tuple[Array, float]:
    """Direction of the fringes in the other image, and how well it is known.

    A fringe is where the surface meets the plane of one projector column (or row): the direction within the tangent
    plane in which that coordinate of the projector does not change. Which axis was projected a measurement does not
    say: the one whose fringes stand across the epipolar lines, for only that one measures depth.
    """
    if rig.projector is None:
        return np.zeros(len(points)), SLACK_UNKNOWN
    _, by_point, _ = project_with_derivatives(rig.projector, points)
    _, other_by_point, _ = project_with_derivatives(other, points)
    gradient = by_point @ tangents
    leans, shares = [], []
    for axis in (0, 1):
        within = np.stack([-gradient[:, axis, 1], gradient[:, axis, 0]], -1)
        image = np.einsum("nij,njk,nk->ni", other_by_point, tangents, within)
        image /= np.linalg.norm(image, axis=1, keepdims=True)
        on = (image * across).sum(1)
        along = image[:, 1] * across[:, 0] - image[:, 0] * across[:, 1]
        shares.append(float(np.median(np.abs(on))))
        leans.append(along / np.where(np.abs(on) < MIN_ACROSS, np.copysign(MIN_ACROSS, on), on))
    best = int(np.argmax(shares))
    return leans[best], SLACK_KNOWN
