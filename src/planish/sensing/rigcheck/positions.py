"""Where the projector's two axes say that a point lies: in the other camera, or in the projector itself.

Two decoded coordinates name one place of the projector: no texture and no epipolar line is needed to find it again.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.rig.parameters import PROJECTOR
from planish.sensing.decode import PhaseMap
from planish.sensing.patterns.entries import Axis
from planish.sensing.rigcheck.pairs import PixelPairs, row_errors
from planish.sensing.rigcheck.places import MIN_PLACES, MIN_SHARE, choose_places, tile_corners, tile_side

SECOND_AXIS, TO_PROJECTOR = "the projector's second axis", "the projector's two axes"
#: Positions change over so many pixels on either side [px] for their slope.
SLOPE_PX = 2.0
#: Neighbouring positions share fringes' remains and interpolated pixels: independent pixels of a tile, one in so many.
ALIKE_PX = 8
#: Every so many pixels of a tile are looked at.
STRIDE_PX = 4
_AXES: tuple[Axis, Axis] = ("u", "v")


def pairs_between_cameras(
    measurement: Measurement, own: Mapping[Axis, PhaseMap], other: Mapping[Axis, PhaseMap]
) -> PixelPairs | None:
    """Return where both cameras see the same projector place; None without both axes or correspondences.

    Parameters
    ----------
    measurement : Measurement
        Of the capture.
    own, other : mapping of PhaseMap
        Positions (H, W) per axis in the organising camera and in the other one.

    Notes
    -----
    With the positions x of `own` at a tile's pixels, x' of `other` at the matched ones and their slope J there, the
    points lie J^-1 (x - x') from the matched pixels; the median over a tile counts.
    """
    if not set(_AXES) <= set(own) & set(other):
        return None
    places = choose_places(measurement)
    if places is None:
        return None
    here = np.stack([places.own_tiles(own[axis].position_px) for axis in _AXES], -1)
    noise = np.stack([places.own_tiles(own[axis].sigma_px) for axis in _AXES], -1)

    def there(shift: tuple[float, float]) -> Map:
        at = places.pixel_px.reshape(-1, places.side_px, 2) + np.array(shift, np.float32)
        parts = [
            cv2.remap(other[axis].position_px, at, None, cv2.INTER_LINEAR, borderValue=np.nan) for axis in _AXES
        ]  # fmt: skip
        return np.stack(parts, -1).reshape(here.shape)

    J = np.stack([(there(step) - there((-step[0], -step[1]))) / (2 * SLOPE_PX) for step in _steps()], -1)
    with np.errstate(all="ignore"):
        determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        inverse = np.stack([J[..., 1, 1], -J[..., 0, 1], -J[..., 1, 0], J[..., 0, 0]], -1) / determinant[..., None]
        inverse = inverse.reshape(J.shape)
        shift = np.einsum("...ij,...j->...i", inverse, here - there((0.0, 0.0)))
        # Both cameras' noise.
        weights = np.einsum("ni,nabij->nabj", places.across, inverse)
        sigma = np.sqrt(2 * ((weights * noise) ** 2).sum(-1))
    known = np.isfinite(shift).all(-1) & np.isfinite(sigma)
    count, move, typical = _medians(known, shift.astype(float), sigma.astype(float))
    pairs = PixelPairs(
        measurement.name, SECOND_AXIS, places.own, places.other, places.center_px, places.there_px + move,
        places.there_px, places.points_sensor, typical, len(places),
    )  # fmt: skip
    return pairs.at(np.flatnonzero(count > MIN_SHARE / 2))


def _steps() -> tuple[tuple[float, float], tuple[float, float]]:
    return (SLOPE_PX, 0.0), (0.0, SLOPE_PX)


def _medians(known: Map, shift: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Share of known pixels (n,), median shift (n, 2) and its standard deviation (n,) of each tile."""
    n = len(known)
    share = known.reshape(n, -1).mean(1)
    move, typical = np.zeros((n, 2)), np.full(n, np.inf)
    for k in np.flatnonzero(share > 0):
        move[k] = np.median(shift[k][known[k]], axis=0)
        # The variance of a median is pi / 2 times that of a mean.
        independent = max(known[k].sum() / ALIKE_PX, 1.0)
        typical[k] = np.sqrt(np.pi / 2 / independent) * np.median(sigma[k][known[k]])
    return share, move, typical


def pairs_to_projector(measurement: Measurement, own: Mapping[Axis, PhaseMap]) -> PixelPairs | None:
    """Return which projector pixel lights each of many camera pixels; None without both axes or a calibrated projector.

    Parameters
    ----------
    measurement : Measurement
        Of the capture.
    own : mapping of PhaseMap
        Positions (H, W) per axis in the organising camera.

    Notes
    -----
    The median of the row errors of a tile's pixels counts, at the tile's centre.
    """
    if measurement.rig.projector is None or not set(_AXES) <= set(own):
        return None
    position = np.stack([own[axis].position_px for axis in _AXES], -1)
    noise = np.stack([own[axis].sigma_px for axis in _AXES], -1)
    known = np.isfinite(position).all(-1) & np.isfinite(noise).all(-1) & measurement.valid
    side = tile_side(measurement.shape[1])
    corners = tile_corners(known, side)
    if len(corners) < MIN_PLACES:
        return None
    pixels, matched, points, shifts, sigmas = [], [], [], [], []
    for u, v in corners:
        rows, columns = np.nonzero(known[v : v + side : STRIDE_PX, u : u + side : STRIDE_PX])
        at = (v + STRIDE_PX * rows, u + STRIDE_PX * columns)
        here = _pairs(measurement, np.column_stack(at[::-1]).astype(float), position[at], measurement.points_sensor[at])
        found = row_errors(here, measurement.rig)
        error = np.median(found.error_px)
        middle = np.argmin(((here.own_px - [u + side / 2, v + side / 2]) ** 2).sum(1))
        on_line = here.other_px[middle] - found.error_px[middle] * found.across[middle]
        sigma = np.sqrt(((found.across * noise[at]) ** 2).sum(1))
        pixels.append(here.own_px[middle])
        matched.append(on_line)
        points.append(here.points_sensor[middle])
        shifts.append(error * found.across[middle])
        sigmas.append(np.sqrt(np.pi / 2 / max(len(rows) * STRIDE_PX**2 / ALIKE_PX, 1.0)) * np.median(sigma))
    at_projector = np.array(matched)
    pairs = _pairs(measurement, np.array(pixels), at_projector + np.array(shifts), np.array(points))
    return PixelPairs(
        pairs.measurement, TO_PROJECTOR, pairs.own, PROJECTOR, pairs.own_px, pairs.other_px, at_projector,
        pairs.points_sensor, np.array(sigmas), len(corners),
    )  # fmt: skip


def _pairs(measurement: Measurement, pixels: Array, there: Map | Array, points: Map | Array) -> PixelPairs:
    other = np.asarray(there, float)
    return PixelPairs(
        measurement.name, TO_PROJECTOR, measurement.organised_on, PROJECTOR, pixels, other, other,
        np.asarray(points, float), np.zeros(len(pixels)), len(pixels),
    )  # fmt: skip
