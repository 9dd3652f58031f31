"""Windows: where the parts of one texture lie in the other, each found by itself around a common placement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.dense.develop import Development
from planish.registration.dense.search import Placement
from planish.registration.dense.spectrum import Spectrum
from planish.registration.texture.sampling import parabola_vertex

#: A window counts where both textures cover this share of it.
_COVERED = 0.6
#: Significance that a window should have by itself, for the first look and for the last [standard deviations].
_WINDOW_SIGMA = (7.0, 4.5)
#: Smallest window [px], most windows.
_LEAST_PX, _MOST = 8, 400
#: What stands still in the image is masked out within this many pixels of the camera.
_STILL_PX = 3.0


@dataclass(frozen=True)
class Windows:
    """n disjoint windows of b with their places in a.

    Parameters
    ----------
    at_a, at_b : ndarray (n, 2)
        Middle of the window in both developments [px].
    correlation : ndarray (n,)
        Normalised cross-correlation at the found place.
    looked_at_px : ndarray (n,)
        Area in which its place was sought.
    """

    at_a: Array
    at_b: Array
    correlation: Array
    looked_at_px: Array


def find_windows(
    a: tuple[Development, Spectrum], b: tuple[Development, Spectrum], start: Placement, radius_px: int
) -> tuple[Windows, Placement]:
    """Return the windows of a placement and the placement that follows from them.

    The first look, with large windows, corrects the placement; the last one counts. A window is sought everywhere
    within `radius_px`, and its place is kept however poor it is: that is what makes chance countable.
    """
    placement = start
    for sigma in _WINDOW_SIGMA:
        size = _window_size(start, sigma)
        found = _correlate(a, b, placement, size, radius_px)
        placement = _corrected(found, placement, radius_px)
    return found, placement


def _window_size(start: Placement, sigma: float) -> int:
    """Edge of windows that hold `sigma` each, the significance growing with the root of the area."""
    count = float(np.clip((start.sigma / sigma) ** 2, 1, _MOST))
    return max(_LEAST_PX, round(float(np.sqrt(start.overlap_px / count))))


def _correlate(
    a: tuple[Development, Spectrum], b: tuple[Development, Spectrum], placement: Placement, size: int, radius: int
) -> Windows:
    (dev_a, spec_a), (dev_b, spec_b) = a, b
    h, w = dev_a.mask.shape
    affine = placement.map()

    def laid(image: Map, how: int = cv2.INTER_LINEAR) -> Map:
        return cv2.warpAffine(image, affine, (w, h), flags=how)

    cover = (laid(dev_b.mask.astype(np.float32)) > 0.5) & dev_a.mask
    corners = _grid(cover, size)
    if len(corners) == 0:
        return Windows(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0))
    patches = _patches(laid(spec_b.filtered, cv2.INTER_CUBIC), corners, size, 0)
    around = _patches(spec_a.filtered, corners, size, radius)
    surfaces = _surfaces(around, patches, radius)
    source_b = cv2.warpAffine(dev_b.source_px, affine, (w, h), borderValue=(np.nan,) * 4)
    still = _still_places(dev_a.source_px, source_b, corners, size)
    shift, peak, looked_at = _peaks(surfaces, still, radius)
    middle = corners[:, ::-1] + 0.5 * (size - 1)
    inverse = np.linalg.inv(affine[:, :2])
    return Windows(middle + shift, (middle - affine[:, 2]) @ inverse.T, peak, looked_at)


def _grid(cover: NDArray[np.bool_], size: int) -> NDArray[np.intp]:
    """First (row, column) of the disjoint windows that are covered well enough."""
    h, w = cover.shape
    if h < size or w < size:
        return np.empty((0, 2), np.intp)
    total = np.pad(np.cumsum(np.cumsum(cover, 0), 1), ((1, 0), (1, 0)))
    inside = total[size:, size:] - total[:-size, size:] - total[size:, :-size] + total[:-size, :-size]
    full = inside >= _COVERED * size * size
    # Of all positions of the grid the one that loses least at the rim of the overlap.
    offsets = [(r, c) for r in range(0, size, max(1, size // 6)) for c in range(0, size, max(1, size // 6))]
    row, column = max(offsets, key=lambda at: int(full[at[0] :: size, at[1] :: size].sum()))
    return np.argwhere(full[row::size, column::size]) * size + np.array([row, column])


def _patches(image: Map, corners: NDArray[np.intp], size: int, margin: int) -> Map:
    """Patches (n, size + 2 margin, ...) of an image, 0 beyond it."""
    padded = np.pad(image, margin)
    view = np.lib.stride_tricks.sliding_window_view(padded, (size + 2 * margin,) * 2)
    return view[corners[:, 0], corners[:, 1]]


def _surfaces(around: Map, patches: Map, radius: int) -> Map:
    """Normalised cross-correlation (n, 2 radius + 1, 2 radius + 1) of each patch with all places around it.

    NaN where less than the needed share of a patch would lie on texture.
    """
    n = fft.next_fast_len(around.shape[1], True)
    size = patches.shape[1]
    keep = (slice(None), slice(0, 2 * radius + 1), slice(0, 2 * radius + 1))
    product = fft.rfft2(around, (n, n)) * np.conj(fft.rfft2(patches, (n, n)))
    surface = fft.irfft2(product, (n, n))[keep]
    total = np.pad(np.cumsum(np.cumsum(around.astype(np.float64) ** 2, 1), 2), ((0, 0), (1, 0), (1, 0)))
    energy = total[:, size:, size:] - total[:, :-size, size:] - total[:, size:, :-size] + total[:, :-size, :-size]
    own = (patches.astype(np.float64) ** 2).sum((1, 2))
    # The filtered texture has unit variance: its energy is the area covered.
    covered = energy >= _COVERED * size * size
    height = surface / np.sqrt(np.maximum(energy * own[:, None, None], 1e-12))
    return np.where(covered, height, np.nan).astype(np.float32)


def _still_places(source_a: Map, source_b: Map, corners: NDArray[np.intp], size: int) -> tuple[Array, Array]:
    """Shift (n, 2) [px] at which each window would show the same camera pixels, and the radius (n,) to be left out."""
    rows, columns = (corners + size // 2).T
    h, w = source_a.shape[:2]
    step = max(1, size // 4)
    up, down = np.maximum(rows - step, 0), np.minimum(rows + step, h - 1)
    left, right = np.maximum(columns - step, 0), np.minimum(columns + step, w - 1)
    along_x = (source_a[rows, right] - source_a[rows, left]) / (right - left)[:, None]
    along_y = (source_a[down, columns] - source_a[up, columns]) / (down - up)[:, None]
    jacobian = np.stack([along_x, along_y], 2).astype(float)
    behind = (source_b[rows, columns] - source_a[rows, columns]).astype(float)
    bad = ~np.isfinite(jacobian).all((1, 2)) | ~np.isfinite(behind).all(1)
    jacobian[bad], behind[bad] = np.eye(2), 1e6
    scale = np.sqrt(np.abs(np.linalg.det(jacobian)))
    return np.linalg.solve(jacobian, behind[..., None])[..., 0], _STILL_PX / np.maximum(scale, 1e-6)


def _peaks(surfaces: Map, still: tuple[Array, Array], radius: int) -> tuple[Array, Array, Array]:
    """Shift (n, 2) of the highest place, interpolated by parabolas, its height (n,), the places looked at (n,)."""
    n, side, _ = surfaces.shape
    y, x = np.indices((side, side)) - radius
    place, out = still
    distance2 = (x - place[:, 0, None, None]) ** 2 + (y - place[:, 1, None, None]) ** 2
    shut = (distance2 < out[:, None, None] ** 2) | np.isnan(surfaces)
    open_ = np.where(shut, np.float32(-2), surfaces)
    best = open_.reshape(n, -1).argmax(1)
    row, column, i = best // side, best % side, np.arange(n)
    r, c = np.clip(row, 1, side - 2), np.clip(column, 1, side - 2)
    middle = surfaces[i, r, c]
    dx = np.where(c == column, parabola_vertex(surfaces[i, r, c - 1], middle, surfaces[i, r, c + 1]), 0)
    dy = np.where(r == row, parabola_vertex(surfaces[i, r - 1, c], middle, surfaces[i, r + 1, c]), 0)
    shift = np.column_stack([column - radius + dx, row - radius + dy])
    return shift, surfaces[i, row, column].astype(float), (~shut).sum((1, 2)).astype(float)


def _corrected(found: Windows, placement: Placement, radius: int) -> Placement:
    """The rigid map that most windows agree on: the densest shift, then a fit to those near it."""
    if len(found.at_a) < 3:
        return placement
    affine = placement.map()
    near = float(radius) / 3
    shift = found.at_a - (found.at_b @ affine[:, :2].T + affine[:, 2])
    crowd = (np.linalg.norm(shift[:, None] - shift[None], axis=2) < near).sum(1)
    members = np.linalg.norm(shift - shift[crowd.argmax()], axis=1) < near
    for _ in range(5):
        if members.sum() < 3:
            return placement
        angle, moved = _fit_rigid_2d(found.at_a[members], found.at_b[members])
        placement = replace(placement, angle_rad=angle, shift_px=moved)
        affine = placement.map()
        members = np.linalg.norm(found.at_a - (found.at_b @ affine[:, :2].T + affine[:, 2]), axis=1) < near
    return placement


def _fit_rigid_2d(at_a: Array, at_b: Array) -> tuple[float, Array]:
    mean_a, mean_b = at_a.mean(0), at_b.mean(0)
    H = (at_b - mean_b).T @ (at_a - mean_a)
    angle = float(np.arctan2(H[0, 1] - H[1, 0], H[0, 0] + H[1, 1]))
    c, s = np.cos(angle), np.sin(angle)
    return angle, mean_a - np.array([[c, -s], [s, c]]) @ mean_b
