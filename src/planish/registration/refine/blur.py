"""What the blur of the images does to heights: points of bent, obliquely seen or unevenly lit surfaces are displaced.

A blurred fringe image shows at a pixel the phase of its neighbourhood, weighted by the light that comes from there. On
surfaces that both cameras see alike the two shifts cancel; towards a limb, where one camera sees the surface more
obliquely than the other, they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.registration.surface import Surface

Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

#: Edge of the squares of pixels whose means the fits see: a mean over a square adds a constant to a quadratic field.
_BIN_PX = 2
#: Scale of the local fits (standard deviation of the window), and distance of the places where they are made [px].
_SCALE_PX, _STEP_PX = 5.0, 4
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


def height_by_blur(measurement: Measurement, surface: Surface, threads: int = 1) -> Map:
    """Return by how much a blur of variance 1 px^2 displaces each point along its normal (H, W) [mm]; 0 where unknown.

    Points of two cameras by fringes or Gray code; the blur is the same in both, and small against what bends.

    Notes
    -----
    To the first order in its variance s, a blur changes the phase of a fringe image of modulation B by
    s (grad phi . grad ln B + laplacian phi / 2). Of two cameras the correspondence shifts by the difference of both,
    each in its own pixels, over the slope of the phase along the epipolar line.
    """
    nothing = np.zeros(measurement.shape, np.float32)
    other = measurement.rig.other(measurement.organised_on)
    view = measurement.views.get(measurement.organised_on)
    light = None if view is None else view.modulation if view.modulation is not None else view.mean
    in_b, position = measurement.correspondence_px, measurement.position_px
    if other is None or other not in measurement.rig.cameras or in_b is None or position is None or light is None:
        return nothing
    normals = surface.normals_sensor
    known = np.isfinite(position) & np.isfinite(in_b[..., 0]) & np.isfinite(normals[..., 2]) & (light > 0)
    fields = [_means(f) for f in (in_b[..., 0], in_b[..., 1], np.where(known, position, np.nan), light)]
    whole = np.isfinite(fields[2])
    step = _STEP_PX // _BIN_PX
    thinned = whole[::step, ::step]
    rows, columns = (index * step for index in np.nonzero(thinned))
    if len(rows) == 0:
        return nothing
    fields[3] = np.log(np.where(whole, fields[3], np.float32(1)))
    fits, enough = _quadratic_fits(fields, whole, rows, columns, threads)
    v, u = rows * _BIN_PX, columns * _BIN_PX
    with np.errstate(all="ignore"):
        shift, by_b = _phase_shifts(*fits)
        points = measurement.points_sensor[v, u].astype(float)
        rays = points - measurement.camera.center_sensor
        rays /= np.sqrt(np.einsum("ni,ni->n", rays, rays))[:, None]
        camera = measurement.rig.cameras[other]
        per_mm = camera.project(points + rays) - camera.project(points)
        slope = by_b[0] * per_mm[:, 0] + by_b[1] * per_mm[:, 1]
        height = shift / slope * np.einsum("ni,ni->n", rays, normals[v, u])
    sparse = np.full(thinned.shape, np.nan, np.float32)
    sparse[thinned] = np.where(enough & np.isfinite(height), height, np.nan)
    return np.where(known, _spread(sparse, measurement.shape), np.float32(0))


def _means(field: Map) -> Map:
    """Means over squares of pixels; NaN where a pixel is unknown."""
    height, width = (n // _BIN_PX for n in field.shape)
    whole = np.ascontiguousarray(field[: height * _BIN_PX, : width * _BIN_PX], np.float32)
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _phase_shifts(u_b: Array, v_b: Array, phase: Array, light: Array) -> tuple[Array, tuple[Array, Array]]:
    """Shift of a's phase less that of b's (n), and slopes of the phase per pixel of b (n) along u and v.

    From fits (6, n): value, two slopes, three second derivatives.
    """
    own = phase[1] * light[1] + phase[2] * light[2] + (phase[3] + phase[5]) / 2
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
    return np.asarray(own - slope[0] * slope_light[0] - slope[1] * slope_light[1] - laplacian / 2), slope


def _quadratic_fits(fields: list[Map], known: Mask, v: Index, u: Index, threads: int = 1) -> tuple[list[Array], Array]:
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
    return fits, number > _MIN_SHARE * sums[0] ** 2


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
    # A place is the middle of its square.
    middle = (_BIN_PX - 1) / 2
    v, u = ((np.arange(n, dtype=np.float32) - middle) / _STEP_PX for n in shape)
    map_u, map_v = np.meshgrid(u, v)
    return cv2.remap(filled, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
