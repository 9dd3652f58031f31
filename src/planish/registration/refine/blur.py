"""What the blur of the images does to heights: points of bent, obliquely seen or unevenly lit surfaces are displaced.

A blurred fringe image shows at a pixel the phase of its neighbourhood, weighted by the light that comes from there. On
surfaces that both cameras see alike the two shifts cancel; towards a limb, where one camera sees the surface more
obliquely than the other, they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.registration.surface import Surface
from planish.rig import Camera

Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

#: Variance of the cubic B-spline through which the correspondence reads the other camera's positions, along each axis
#: [px^2]: that of the sum of four uniform distributions of 1 px.
_SPLINE = 4 / 12
#: Slope against the other camera's rays (72 degrees) from which on the surface bends too much in its few pixels there
#: for fits of second order: points are off along their normals by parts of their noise, all to the same side.
_MAX_SLOPE = 3.0
#: Edge of the squares of pixels whose means the fits see: a mean over a square adds a constant to a quadratic field.
_BIN_PX = 2
#: Scale of the local fits (standard deviation of the window), and distance of the places where they are made [px].
_SCALE_PX, _STEP_PX = 5.0, 4
#: How much farther from its first pixel the middle of a square of that distance lies than that of such a mean [px].
_OFFSET = (_STEP_PX - _BIN_PX) // 2
#: Half the window, in scales.
_REACH = 2.5
#: Powers of (u, v) in a fit of second order.
_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
#: Those of the products of two such.
_MOMENTS = tuple((p, q) for p, q in product(range(5), range(5)) if p + q <= 4)
#: Of float32 sums over a window.
_ROUNDING = 1e-5
#: A fit needs so many times the window's share that a corner of a surface fills.
_MIN_SHARE = 0.15


def height_by_blur(measurement: Measurement, surface: Surface, threads: int = 1) -> tuple[Map, Map]:
    """Return by how much averages over the images' neighbourhoods displace each point along its normal (H, W) [mm].

    First per 1 px^2 of the variance of the cameras' blur, which is the same in both, and small against what bends; then
    by the spline that reads the other camera's positions between its pixels. Points by fringes or Gray code; 0 where
    unknown. By the spline NaN where the other camera sees the surface so obliquely that its pixels, and those that the
    spline needs beside them, see too much of its bend: points are off there by more than these derivatives tell.

    Notes
    -----
    To the first order in its variance s, a blur changes the phase of a fringe image of modulation B by
    s (grad phi . grad ln B + laplacian phi / 2). Of two cameras the correspondence shifts by the difference of both,
    each in its own pixels, over the slope of the phase along the epipolar line. The spline averages the phases
    themselves, without the light, in the other camera alone. A point of camera and projector moves by all that the
    camera's phase does.
    """
    by_blur, by_spline = np.zeros((2, *measurement.shape), np.float32)
    view = measurement.views.get(measurement.organised_on)
    light = None if view is None else view.modulation if view.modulation is not None else view.mean
    position, in_b = measurement.position_px, measurement.correspondence_px
    if position is None or light is None:
        return by_blur, by_spline
    rig, centre = measurement.rig, measurement.camera.center_sensor
    maps = measurement.points_sensor, surface.normals_sensor
    known = np.isfinite(position) & np.isfinite(maps[1][..., 2]) & (light > 0)
    alone, other = known, rig.other(measurement.organised_on)
    if other in rig.cameras and in_b is not None:
        seen = known & np.isfinite(in_b[..., 0])
        places = _Places.of(maps[0], maps[1], centre, seen)
        fits, enough = places.fits([in_b, position, light], threads)
        with np.errstate(all="ignore"):
            shift, laplacian, by_b = _phase_shifts(*fits)
            per_mm = places.motion(rig.cameras[other])
            slope = by_b[0] * per_mm[:, 0] + by_b[1] * per_mm[:, 1]
            by_blur, by_spline = (places.spread(x / slope, enough) for x in (shift, -_SPLINE * laplacian / 2))
        by_spline[places.near(places.grazed_by(rig.cameras[other]))] = np.nan
        alone = known & ~seen
    if rig.projector is not None and measurement.projector_weights is not None and alone.any():
        # Neighbours that the other camera sees too tell how light and positions bend.
        part = _around(alone)
        places = _Places.of(maps[0][part], maps[1][part], centre, known[part])
        (phase, ln_light), enough = places.fits([position[part], light[part]], threads)
        with np.errstate(all="ignore"):
            per_mm = places.motion(rig.projector)[:, int(np.argmax(measurement.projector_weights))]
            of_part = places.spread(_phase_shift(phase, ln_light) / per_mm, enough)
        by_blur[part] = np.where(alone[part], of_part, by_blur[part])
    return by_blur, by_spline


def _around(mask: Mask) -> tuple[slice, slice]:
    """Return rows and columns that hold all of a mask and the windows of the fits around it."""
    margin = int(np.ceil(_REACH * _SCALE_PX)) + _STEP_PX
    out = []
    for axis in (1, 0):
        of_mask = np.flatnonzero(mask.any(axis))
        out.append(slice(max(of_mask[0] - margin, 0), of_mask[-1] + 1 + margin))
    return out[0], out[1]


@dataclass(frozen=True)
class _Places:
    """Every few pixels within `known` (H, W), where local fits are made: rows and columns of `whole`, the means.

    Points, directions of their rays and normals (n, 3) are those of the places.
    """

    points: Array
    rays: Array
    normals: Map
    known: Mask
    whole: Mask
    rows: Index
    columns: Index

    @classmethod
    def of(cls, points: Map, normals: Map, centre: Array, known: Mask) -> Self:
        """Return the places within what is known; points and normals (H, W, 3), `centre` is where rays start."""
        whole = np.isfinite(_means(np.where(known, np.float32(0), np.float32(np.nan))))
        step = _STEP_PX // _BIN_PX
        rows, columns = (index * step for index in np.nonzero(whole[::step, ::step]))
        pixels = rows * _BIN_PX, columns * _BIN_PX
        at = points[pixels].astype(float)
        return cls(at, _directions(at - centre), normals[pixels], known, whole, rows, columns)

    def fits(self, fields: list[Map], threads: int) -> tuple[list[Array], Mask]:
        """Fits (6, n) to fields (H, W) or (H, W, C), of the last one's logarithm, and where pixels are enough for them.

        Of what is not known, the fits see nothing.
        """
        means = [mean for f in fields for mean in cv2.split(_means(f))]
        means[-1] = np.log(np.where(self.whole, means[-1], np.float32(1)))
        return _quadratic_fits(means, self.whole, self.rows, self.columns, threads)

    def motion(self, device: Camera) -> Array:
        """Motion (n, 2) of the places' points in another device as they move by 1 mm along their rays [px]."""
        return np.asarray(device.project(self.points + self.rays) - device.project(self.points))

    def grazed_by(self, device: Camera) -> Mask:
        """Which places (n) a device sees too obliquely."""
        cosines = -np.einsum("ni,ni->n", _directions(self.points - device.center_sensor), self.normals)
        return np.asarray(cosines < 1 / np.hypot(1, _MAX_SLOPE))

    def near(self, chosen: Mask) -> Mask:
        """Pixels (H, W) within `known` that are nearer to the chosen places (n) than to others."""
        return self.known & (self._all_over(chosen.astype(float), np.ones_like(chosen)) > 0.5)

    def spread(self, along_ray_mm: Array, use: Mask) -> Map:
        """Displacement along the normals (H, W), from those of the places (n) along their rays; 0 where unknown."""
        height = along_ray_mm * np.einsum("ni,ni->n", self.rays, self.normals)
        return np.where(self.known, self._all_over(height, use), np.float32(0))

    def _all_over(self, values: Array, use: Mask) -> Map:
        step = _STEP_PX // _BIN_PX
        sparse = np.full(self.whole[::step, ::step].shape, np.nan, np.float32)
        sparse[self.rows // step, self.columns // step] = np.where(use & np.isfinite(values), values, np.nan)
        return _spread(sparse, self.known.shape)


def _directions(rays: Array) -> Array:
    """Rays (n, 3) of length 1."""
    return np.asarray(rays / np.sqrt(np.einsum("ni,ni->n", rays, rays))[:, None])


def _means(field: Map) -> Map:
    """Means over squares of pixels; NaN where a pixel is unknown."""
    height, width = (n // _BIN_PX for n in field.shape[:2])
    whole = np.ascontiguousarray(field[: height * _BIN_PX, : width * _BIN_PX], np.float32)
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _phase_shifts(u_b: Array, v_b: Array, phase: Array, light: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Shift of a's phase less that of b's, its Laplacian in b's pixels (n), its slopes there (n) along u and v.

    From fits (6, n): value, two slopes, three second derivatives.
    """
    own = _phase_shift(phase, light)
    # From a's pixels to b's lead [[p, q], [r, s]]; from b's to a's the inverse, its columns a step along u and along v.
    p, q, r, s = u_b[1], u_b[2], v_b[1], v_b[2]
    determinant = p * s - q * r
    along_u, along_v = (s / determinant, -r / determinant), (-q / determinant, p / determinant)
    slope, slope_light = (
        (f[1] * along_u[0] + f[2] * along_u[1], f[1] * along_v[0] + f[2] * along_v[1]) for f in (phase, light)
    )
    # Chain rule of second derivatives: H_a = J' H_b J + sum of the slopes times the map's own second derivatives.
    bent = phase[3:] - slope[0] * u_b[3:] - slope[1] * v_b[3:]
    laplacian = sum(x * x * bent[0] + 2 * x * y * bent[1] + y * y * bent[2] for x, y in (along_u, along_v))
    own -= slope[0] * slope_light[0] + slope[1] * slope_light[1] + laplacian / 2
    return np.asarray(own), np.asarray(laplacian), slope


def _phase_shift(phase: Array, light: Array) -> Array:
    """Shift of the phase (n) by a blur of 1 px^2, from fits (6, n) to it and to the logarithm of the light."""
    return np.asarray(phase[1] * light[1] + phase[2] * light[2] + (phase[3] + phase[5]) / 2)


def _quadratic_fits(fields: list[Map], known: Mask, v: Index, u: Index, threads: int = 1) -> tuple[list[Array], Mask]:
    """Value, d/du, d/dv, d2/du2, d2/dudv, d2/dv2 (6, n) of each field at places (n), by weighted least squares.

    Fields and places are those of means (`_means`), each of a place's indices a multiple of what lies between them;
    derivatives are per pixel.
    """
    scale, step = _SCALE_PX / _BIN_PX, _STEP_PX // _BIN_PX
    t = np.arange(-int(_REACH * scale), int(_REACH * scale) + 1) / scale
    columns = [np.exp(-0.5 * t**2) * t**p for p in range(5)]
    taps, shape = [c.tolist() for c in columns], (-(-known.shape[0] // step), -(-known.shape[1] // step))

    def moments(image: Map, powers: Sequence[tuple[int, int]]) -> Map:
        return _core.window_moments(image, taps, powers, step, shape, threads)

    row, column = v // step, u // step
    shares = moments(known.astype(np.float32), _MOMENTS)
    number, sums = shares[_MOMENTS.index((0, 0)), row, column], [c.sum() for c in columns]
    # Within a surface all windows are the same.
    rim = np.flatnonzero(number < (1 - _ROUNDING) * sums[0] ** 2)
    inside = _products({(p, q): np.array([sums[p] * sums[q]]) for p, q in _MOMENTS})[0]
    at_rim = _products(dict(zip(_MOMENTS, shares[:, row[rim], column[rim]].astype(float), strict=True)))
    # About a plane, so that float32 sums keep what is bent.
    grid_v, grid_u = np.ogrid[: known.shape[0], : known.shape[1]]
    some = _some(known)
    per = np.array([1, 1 / _SCALE_PX, 1 / _SCALE_PX, *[2 / _SCALE_PX**2, 1 / _SCALE_PX**2, 2 / _SCALE_PX**2]])
    inverse, of_rim = np.linalg.inv(inside), np.linalg.inv(at_rim)
    fits = []
    for field in fields:
        plane = _plane(field, *some)
        rest = field - (plane[0] + plane[2] * grid_v).astype(np.float32) - (plane[1] * grid_u).astype(np.float32)
        rest[~known] = 0
        sides = moments(rest, _POWERS)[:, row, column].astype(float)
        found = inverse @ sides
        found[:, rim] = np.einsum("nij,jn->in", of_rim, sides[:, rim])
        found *= per[:, None]
        found[1:3] += plane[1:, None] / _BIN_PX
        fits.append(found)
    return fits, np.asarray(number > _MIN_SHARE * sums[0] ** 2)


def _products(moments: dict[tuple[int, int], Array]) -> Array:
    """Weighted sums (n, 6, 6) of the products of two powers each."""
    M = np.empty((len(moments[0, 0]), 6, 6))
    for (i, first), (j, second) in product(enumerate(_POWERS), repeat=2):
        M[:, i, j] = moments[first[0] + second[0], first[1] + second[1]]
    # A window that holds a line of pixels alone says nothing across it.
    return np.asarray(M + 1e-6 * np.eye(6))


def _some(known: Mask) -> tuple[Index, Index]:
    """Rows and columns of some of the known places."""
    step = max(1, int(np.sqrt(np.count_nonzero(known) / 2000)))
    v, u = np.nonzero(known[::step, ::step])
    return v * step, u * step


def _plane(field: Map, v: Index, u: Index) -> Array:
    """Coefficients (1, u, v) of a plane through a sample of the field."""
    found, *_ = np.linalg.lstsq(np.stack([np.ones(len(u)), u, v], 1), field[v, u].astype(float), rcond=None)
    return np.asarray(found)


def _spread(sparse: Map, shape: tuple[int, int]) -> Map:
    """Values of every n-th pixel at all pixels: linear between known ones, the nearest known beside them."""
    known = np.isfinite(sparse)
    if not known.any():
        return np.zeros(shape, np.float32)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(labels.max()) + 1, np.float32)
    of_label[labels[known]] = sparse[known]
    filled = of_label[labels]
    filled = cv2.copyMakeBorder(filled, 0, 1, 0, 1, cv2.BORDER_REPLICATE)
    rows, columns = filled.shape
    whole = cv2.resize(filled, (columns * _STEP_PX, rows * _STEP_PX), interpolation=cv2.INTER_LINEAR)
    # A place is the middle of its square of means, to the enlarged image that of a square as large as the step.
    return whole[_OFFSET : _OFFSET + shape[0], _OFFSET : _OFFSET + shape[1]]
