"""Where the texture of both cameras says that a point really lies: the shift of each place in the other image.

The pixel that was matched lies on the epipolar line of the rig by construction, and on the right fringe. The point
itself lies elsewhere on that fringe, which need not cross the line at right angles: the shift is looked for in both
directions, and the direction of the fringe enters as what is known beforehand.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.measurement import Map, Measurement, View
from planish.sensing.rigcheck.pairs import PixelPairs
from planish.sensing.rigcheck.places import MIN_PLACES, Places, choose_places

SOURCE = "the cameras' textures"
#: Shifts are searched so far, and where fewer than this share of the places show one, so far [px].
NEAR_PX, FAR_PX, FEW_SHARE = 4, 24, 0.5
#: Correlation of two tiles beyond what unrelated textures have, in standard deviations.
RELATED_SIGMAS = 6.0
#: Pixels of a tile that are alike with their neighbours, per independent one.
ALIKE_PX = 4
#: Shading, which both cameras see differently, is the mean over this share of a tile; tiles lose half of it as margin.
SHADING_SHARE = 0.3
#: Steps of the refinement; each doubles the digits.
REFINEMENTS = 3
#: A point is known to lie on its fringe to this [px].
ON_FRINGE_PX = 0.05
#: A place does not count where its shift across the lines is known less well than this, or does not settle [px].
MAX_SIGMA_PX, MAX_STEP_PX = 0.5, 0.5


def pairs_by_texture(measurement: Measurement) -> PixelPairs | None:
    """Return where both cameras see the same texture; None where correspondences or images are missing."""
    places = choose_places(measurement)
    if places is None:
        return None
    images = [_texture(measurement.views.get(name)) for name in (places.own, places.other)]
    if images[0] is None or images[1] is None:
        return None
    start, found = _search(places, images[0], images[1])
    if found.sum() >= MIN_PLACES:
        shift, sigma, good = _refine(places, images[0], images[1], start, found)
    else:
        shift, sigma, good = start, np.full(len(places), np.inf), np.zeros(len(places), np.bool_)
    pairs = PixelPairs(
        measurement.name, SOURCE, places.own, places.other, places.center_px, places.there_px + shift,
        places.there_px, places.points_sensor, sigma, len(places),
    )  # fmt: skip
    return pairs.at(np.flatnonzero(good))


def _texture(view: View | None) -> Map | None:
    if view is None:
        return None
    return view.mean if view.mean is not None else view.white


def _shading_px(side: int) -> int:
    return 2 * round(side * SHADING_SHARE / 2) + 1


def _flat(tiles: Map, shading_px: int) -> Map:
    """Return tiles (n, h, w) relative to their brightness and without slow shading, their margin cut off."""
    known = np.isfinite(tiles)
    filled = np.where(known, tiles, np.float32(0))
    mean = filled.sum((1, 2), keepdims=True) / np.maximum(known.sum((1, 2), keepdims=True), 1)
    flat = np.where(known, filled / np.maximum(mean, np.float32(1e-3)) - 1, 0).astype(np.float32)
    weight = known.astype(np.float32)
    margin = shading_px // 2
    out = np.empty((len(tiles), tiles.shape[1] - 2 * margin, tiles.shape[2] - 2 * margin), np.float32)
    size = (shading_px, shading_px)
    for k in range(len(tiles)):
        slow = cv2.blur(flat[k], size) / np.maximum(cv2.blur(weight[k], size), np.float32(1e-3))
        out[k] = ((flat[k] - slow) * weight[k])[margin:-margin, margin:-margin]
    return out


def _search(places: Places, own: Map, other: Map) -> tuple[Array, NDArray[np.bool_]]:
    """Return the shift (n, 2) [px] of each place to a pixel, and whether its peak stands out."""
    shift, found = _peaks(places, own, other, NEAR_PX)
    if found.mean() < FEW_SHARE:
        far, far_found = _peaks(places, own, other, FAR_PX)
        if far_found.sum() > found.sum():
            return far, far_found
    return shift, found


def _peaks(places: Places, own: Map, other: Map, reach_px: int) -> tuple[Array, NDArray[np.bool_]]:
    shading = _shading_px(places.side_px)
    a = _flat(places.own_tiles(own), shading)
    b = _flat(_windows(places, other, reach_px), shading)
    shift, found = np.zeros((len(places), 2)), np.zeros(len(places), np.bool_)
    limit = RELATED_SIGMAS / np.sqrt(a[0].size / ALIKE_PX)
    for k in range(len(places)):
        if not a[k].any() or not b[k].any():
            continue
        score = np.nan_to_num(cv2.matchTemplate(b[k], a[k], cv2.TM_CCORR_NORMED))
        _, best, _, (column, row) = cv2.minMaxLoc(score)
        inside = 0 < column < 2 * reach_px and 0 < row < 2 * reach_px
        shift[k] = places.affine[k] @ [column - reach_px, row - reach_px]
        found[k] = inside and best > limit
    across = (shift * places.across).sum(1)
    aside = (shift * places.along).sum(1) - places.lean * across
    # Nothing moves along the epipolar line but what moves along its fringe.
    found &= np.abs(aside) < 2 + 2 * places.slack * np.abs(across)
    return shift, found


def _windows(places: Places, other: Map, reach_px: int) -> Map:
    """Return the other image on the pixel grid of the tiles and so many pixels around, (n, h, h)."""
    grid = np.arange(-reach_px, places.side_px + reach_px, dtype=float)
    windows = []
    for k in range(len(places)):
        here = np.stack(np.meshgrid(grid, grid), -1) + places.corner_px[k] - places.center_px[k]
        at = (here @ places.affine[k].T + places.there_px[k]).astype(np.float32)
        windows.append(cv2.remap(other, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan))
    return np.array(windows, np.float32)


def _refine(
    places: Places, own: Map, other: Map, start: Array, found: NDArray[np.bool_]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return shifts (n, 2), their standard deviation across the epipolar lines (n,), and whether they settled.

    Notes
    -----
    C(d) = sum a b(d), both freed of slow shading: independent noise adds no bias to C. Its paraboloid through nine
    neighbours has the gradient g and the curvature -H, cov(g) = r H + N r^2 / 8 with r the variance of what a and b
    do not share. The shift d + H^-1 g with the information H cov(g)^-1 H is joined with the direction of the fringe.
    """
    shading = _shading_px(places.side_px)
    a = _flat(places.own_tiles(own), shading)
    axes = np.stack([places.across, places.along], 1)
    shift = start.copy()
    for _ in range(REFINEMENTS):
        g, H, unlike = _paraboloid(places, a, other, shift, axes, shading)
        local = np.einsum("nij,nj->ni", axes, shift)
        step, covariance = _join(g, H, unlike, a[0].size, local, places)
        step = np.clip(step, -1, 1)
        shift = shift + np.einsum("nij,ni->nj", axes, step)
    sigma = np.sqrt(covariance[:, 0, 0])
    good = found & np.isfinite(sigma) & (sigma < MAX_SIGMA_PX) & (np.abs(step).max(1) < MAX_STEP_PX)
    return shift, sigma, good


def _paraboloid(
    places: Places, a: Map, other: Map, shift: Array, axes: Array, shading: int
) -> tuple[Array, Array, Array]:
    """Gradient (n, 2), curvature (n, 2, 2) of the correlation per px, and variance (n,) of what both do not share."""
    c = np.empty((3, 3, len(places)))
    for i, j in np.ndindex(3, 3):
        b = _flat(places.other_tiles(other, shift + (i - 1) * axes[:, 0] + (j - 1) * axes[:, 1]), shading)
        c[i, j] = np.einsum("nij,nij->n", a, b, dtype=float)
        if i == j == 1:
            gain = c[1, 1] / np.maximum(np.einsum("nij,nij->n", b, b, dtype=float), 1e-12)
            unlike = ((a - gain[:, None, None].astype(np.float32) * b) ** 2).mean((1, 2), dtype=float)
    g = 0.5 * np.stack([c[2, 1] - c[0, 1], c[1, 2] - c[1, 0]], -1)
    H = np.empty((len(places), 2, 2))
    H[:, 0, 0], H[:, 1, 1] = 2 * c[1, 1] - c[0, 1] - c[2, 1], 2 * c[1, 1] - c[1, 0] - c[1, 2]
    H[:, 0, 1] = H[:, 1, 0] = -0.25 * (c[2, 2] + c[0, 0] - c[0, 2] - c[2, 0])
    return g, H, unlike


def _join(
    g: Array, H: Array, unlike: Array, count: int, local: Array, places: Places
) -> tuple[Array, Array]:  # fmt: skip
    """Step (n, 2) and covariance (n, 2, 2) of the shift across and along, with the direction of the fringe."""
    step, covariance = np.zeros((len(g), 2)), np.full((len(g), 2, 2), np.nan)
    for k in range(len(g)):
        values = np.linalg.eigvalsh(H[k])
        if values[1] <= 0 or not np.isfinite(values).all():
            continue
        # A ridge may be bent the wrong way along itself by noise: there it says nothing.
        bent = H[k] if values[0] > 0 else H[k] + (1e-3 * values[1] - values[0]) * np.eye(2)
        weight = bent @ np.linalg.inv(unlike[k] * bent + count * unlike[k] ** 2 / 8 * np.eye(2))
        on_fringe = np.array([-places.lean[k], 1.0])
        variance = (places.slack * local[k, 0]) ** 2 + ON_FRINGE_PX**2
        information = weight @ bent + np.outer(on_fringe, on_fringe) / variance
        covariance[k] = np.linalg.inv(information)
        step[k] = covariance[k] @ (weight @ g[k] - on_fringe * (on_fringe @ local[k]) / variance)
    return step, covariance
