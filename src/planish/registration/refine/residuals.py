"""The residuals of the joint refinement: surface distance along the normal, difference of the textures.

Both are looked up: a point of b is moved into a, projected into a's organising camera and compared with what stands at
that pixel. The texture is compared where the cameras saw it, so that nothing is resampled before and an error of a
point's depth moves the look-up only by the angle between the two viewing rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.surface import Surface
from planish.registration.tiles import held_out, tile_size_px


@dataclass(frozen=True)
class JointSide:
    """One measurement as the refinement sees it: its camera and `maps`, one tuple per smoothing of the texture.

    Parameters
    ----------
    camera : ndarray (29,)
        Kernel parameters of the organising camera.
    smoothing_px : float
        Standard deviation of the Gaussian on the texture [px].
    maps : tuple
        points (H, W, 3) [mm], normals (H, W, 3), texture (H, W), gradient (H, W, 3) [1/mm], sigma (H, W), use (H, W).
    """

    camera: Array
    smoothing_px: float
    maps: tuple[Map, Map, Map, Map, Map, NDArray[np.uint8]]


def held_out_pixels(measurement: Measurement) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of the tiles that take no part in any fit against this measurement."""
    size = tile_size_px(measurement)
    rows, columns = np.indices(measurement.shape) // size
    return held_out(rows, columns)


def joint_side(
    measurement: Measurement,
    surface: Surface,
    contrast: tuple[Map, Map],
    smoothing_px: float,
    use: NDArray[np.bool_] | None = None,
    threads: int | None = None,
) -> JointSide:
    """Return the maps of one measurement, its texture smoothed by `smoothing_px`; `use` (H, W) restricts the pixels."""
    value, sigma = contrast
    known = np.isfinite(value)
    smooth = smooth_texture(value, known, smoothing_px)
    gradient = _core.tangential_gradient(smooth, surface.tangents_sensor, thread_count(threads))
    use = np.ones(measurement.shape, bool) if use is None else use
    # The points as measured: the smoothed ones lie behind a curved surface by an amount that depends on the view.
    points = np.where(np.isfinite(surface.points_sensor), measurement.points_sensor, np.float32(np.nan))
    maps = (
        points,
        surface.normals_sensor,
        smooth,
        gradient,
        np.where(known, sigma, np.float32(np.nan)),
        use.astype(np.uint8),
    )
    return JointSide(measurement.camera.kernel_parameters, smoothing_px, maps)


def smooth_texture(value: Map, known: NDArray[np.bool_], sigma_px: float) -> Map:
    """Gaussian smoothing over known pixels (normalised convolution); NaN stays NaN."""
    blur: Callable[[Map], Map] = lambda image: cv2.GaussianBlur(  # noqa: E731
        image, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT
    )
    density = blur(known.astype(np.float32))
    with np.errstate(divide="ignore", invalid="ignore"):
        smooth = blur(np.where(known, value, np.float32(0))) / density
    return np.where(known, smooth, np.float32(np.nan))


@dataclass(frozen=True)
class Equations:
    """Normal equations of the joint cost at one transform, xi = [rotation rad, translation mm] about a point of a.

    The `unbiased` are the information without what the noise of normals and gradients adds.
    `slope_distance` and `slope_texture` are the sums of psi'(r) over those of psi(r) / r of the robust influence psi:
    by so much of H the gradient really changes. `tile_gradients` (rows, columns, 2, 6) are the parts of the gradient of
    distance and texture from each tile of b. `H_anchor` and `g_anchor` are those of windows (`Anchor`).
    """

    H_distance: Array
    g_distance: Array
    H_texture: Array
    g_texture: Array
    H_distance_unbiased: Array
    H_texture_unbiased: Array
    slope_distance: float
    slope_texture: float
    cost: float
    points: int
    texture_points: int
    correlation: float
    tile_gradients: Array
    distances: Map
    differences: Map
    H_anchor: Array = field(default_factory=lambda: np.zeros((6, 6)))
    g_anchor: Array = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True)
class Weights:
    """Robust scales and weights of both kinds of residual (texture differences are in units of their noise)."""

    scale_distance_mm: float
    scale_texture: float
    distance: float
    texture: float

    @classmethod
    def from_residuals(cls, equations: Equations, smoothing_px: float) -> Weights:
        """Robust scales from residual maps (1.4826 MAD), and from them the weight of a raw pixel's information.

        Neighbouring values of the smoothed texture are correlated; the sum over all pixels carries the information of
        the raw ones. Noise behind a Gaussian of s px has 1 / (4 pi s^2) of its variance.
        """
        s_d = max(_mad(equations.distances), 1e-5)
        s_t = max(_mad(equations.differences), 1e-6)
        raw_texture = s_t**2 * max(1.0, 4 * np.pi * smoothing_px**2)
        return cls(s_d, s_t, 1 / s_d**2, 1 / raw_texture)


def _mad(values: Map) -> float:
    known = values[np.isfinite(values)]
    return 1.4826 * float(np.median(np.abs(known - np.median(known)))) if known.size else 0.0


def equations(
    a: JointSide,
    b: JointSide,
    T_a_b: Array,
    about: Array,
    weights: Weights | None,
    *,
    max_distance_mm: float,
    max_normal_rad: float,
    stride: int,
    tile_px: int,
    residuals: bool,
    threads: int,
) -> Equations:
    """Return the normal equations of b against a; `weights` None = every residual counts alike (to find the scales)."""
    w = weights or Weights(np.inf, np.inf, 1.0, 1.0)
    d, t, Hd, Ht, correlation, tiles, distances, differences = _core.joint_normal_equations(
        a.maps, a.camera, b.maps, np.ascontiguousarray(T_a_b), np.asarray(about, float),
        _kernel_options(w, max_distance_mm, max_normal_rad, stride, tile_px), residuals, threads,
    )  # fmt: skip
    return Equations(
        d[0], d[1][0], t[0], t[1][0], Hd, Ht, d[4], t[4], d[2] + t[2], d[3], t[3], correlation,
        tiles.reshape(*tiles.shape[:2], 2, 6), distances, differences,
    )  # fmt: skip


@dataclass(frozen=True)
class Pull:
    """What displacements do to the gradient of the joint cost, per tile (n) of b that meets the surface of a.

    Parameters
    ----------
    pixels : ndarray (n, 2) int
        (u, v) of the pixel of b nearest to the tile's middle.
    distance, texture : ndarray (n, 6, 3)
        Change of the gradient of either kind by a displacement [mm] in frame a of the tile's points of b and of their
        texture; displacements of a's points count with the opposite sign.
    """

    pixels: NDArray[np.intp]
    distance: Array
    texture: Array


def pull(
    a: JointSide,
    b: JointSide,
    T_a_b: Array,
    about: Array,
    weights: Weights,
    *,
    max_distance_mm: float,
    max_normal_rad: float,
    stride: int,
    tile_px: int,
    threads: int,
) -> Pull:
    """Return how the gradient of `equations` changes where points and texture of one side are displaced."""

    def of(w: Weights) -> tuple[Array, NDArray[np.int64]]:
        by_shift, places = _core.joint_pull(
            a.maps, a.camera, b.maps, np.ascontiguousarray(T_a_b), np.asarray(about, float),
            _kernel_options(w, max_distance_mm, max_normal_rad, stride, tile_px), threads,
        )  # fmt: skip
        return by_shift, places[0]

    distance, places = of(replace(weights, texture=0.0))
    texture, _ = of(replace(weights, distance=0.0))
    met = places >= 0
    v, u = np.divmod(places[met], b.maps[0].shape[1])
    return Pull(np.stack([u, v], -1), distance[met], texture[met])


def _kernel_options(
    w: Weights, max_distance_mm: float, max_normal_rad: float, stride: int, tile_px: int
) -> tuple[float, float, float, float, float, float, int, int]:
    tile = max(stride, tile_px // stride * stride)
    return (
        max_distance_mm, float(np.cos(max_normal_rad)), w.scale_distance_mm, w.scale_texture, w.distance, w.texture,
        stride, tile,
    )  # fmt: skip
