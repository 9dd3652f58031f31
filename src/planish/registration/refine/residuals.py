"""The residuals of the joint refinement: surface distance along the normal, difference of the textures.

Both are looked up: a point of b is moved into a, projected into a's organising camera and compared with what stands at
that pixel. The texture is compared where the cameras saw it, so that nothing is resampled before and an error of a
point's depth moves the look-up only by the angle between the two viewing rays. Residuals are in units of their noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map
from planish.registration.refine.sides import JointSide


@dataclass(frozen=True)
class Equations:
    """Normal equations of the joint cost at one transform, xi = [rotation rad, translation mm] about a point of a.

    The `unbiased` are the information without what the noise of normals and gradients adds.
    `slope_distance` and `slope_texture` are the sums of psi'(r) over those of psi(r) / r of the robust influence psi:
    by so much of H the gradient really changes. Of each tile (`tile` px) of b, `tile_gradients` (rows, columns, 2, 6)
    are the parts of the gradient of distance and texture, `tile_sizes` (rows, columns, 2, 2) number and sum of the
    absolute values of the residuals, `tile_shading` (rows, columns, 18) the sums that gain and offset of its textures
    follow from (`shading`): of J by the gain and by the offset, of the squares, of the residuals. `g_blur` is the
    change of `g_distance` by the standard deviation of the blur.
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
    tile: int
    tile_gradients: Array
    tile_sizes: Array
    tile_shading: Array
    distances: Map
    differences: Map
    g_blur: Array = field(default_factory=lambda: np.zeros(6))

    @property
    def sums(self) -> TileSums:
        """What weights and shading follow from."""
        shape = self.tile_shading.shape[:2]
        squares = self.tile_shading[..., 12:16].reshape(*shape, 2, 2)
        return TileSums(self.tile, self.tile_sizes, squares, self.tile_shading[..., 16:18])


@dataclass(frozen=True)
class TileSums:
    """Sizes of the residuals in each tile (`tile` px) of b, and what gain and offset of its textures follow from.

    `sizes` (rows, columns, 2, 2) are `tile_sizes` of `Equations`; with the robust weights W, the residuals r and their
    derivatives M by gain and offset, with the opposite sign, `squares` (rows, columns, 2, 2) are M'WM and `residuals`
    (rows, columns, 2) M'Wr.
    """

    tile: int
    sizes: Array
    squares: Array
    residuals: Array


#: Standard deviation of normal values over their mean absolute value.
PER_MEAN_ABSOLUTE = float(np.sqrt(np.pi / 2))
#: The scale of all tiles counts in each as much as so many of its own residuals.
PRIOR = 50.0
#: Tukey's biweight is 0 from so many scales on.
TUKEY = _core.TUKEY
#: Smallest scale, where there is no noise at all.
_LEAST_SCALE = 1e-3


@dataclass(frozen=True)
class Weights:
    """How residuals count in each tile of b.

    Parameters
    ----------
    values : ndarray (rows, columns, 2, 4) float32
        Of distances, of texture differences: robust scale; weight of a squared residual over its noise; gain and offset
        of a's texture over b's (of distances unused).
    tile : int
        Edge of a tile [px].
    """

    values: Map
    tile: int

    @classmethod
    def alike(cls, b: JointSide, tile: int, distance: float = 1.0, texture: float = 1.0, scale: float = np.inf) -> Self:
        """Return weights by which all residuals of a kind count alike."""
        rows, columns = (-(-n // tile) for n in b.texture.shape)
        of_tile = np.array([[scale, distance, 0, 0], [scale, texture, 0, 0]], np.float32)
        return cls(np.tile(of_tile, (rows, columns, 1, 1)), tile)

    @classmethod
    def from_residuals(cls, sums: TileSums, noise_passed: float) -> Self:
        """Return weights from the size of the residuals in each tile and its neighbours.

        Where residuals are larger than their noise (highlights, dust, shading by noisy normals, distortion), they count
        by what they are; where they are smaller, noise is still noise. `noise_passed` is the variance of texture
        differences over that of their noise. Tiles that meet nothing, nor do their neighbours, weigh nothing: they need
        not be looked at again.
        """
        out = np.zeros((*sums.sizes.shape[:3], 4), np.float32)
        met = around(sums.sizes[:, :, 0, 0]) > 0
        for kind, expected in enumerate((1.0, np.sqrt(noise_passed))):
            number, absolute = np.moveaxis(sums.sizes[:, :, kind], 2, 0)
            mean = absolute.sum() / max(number.sum(), 1.0)
            scale = PER_MEAN_ABSOLUTE * (around(absolute) + PRIOR * mean) / (around(number) + PRIOR)
            out[:, :, kind, 0] = np.maximum(scale, _LEAST_SCALE)
            out[:, :, kind, 1] = np.where(met, 1 / np.maximum(1.0, scale / expected) ** 2, 0.0)
        return cls(out, sums.tile)

    def only(self, kind: int) -> Weights:
        """Return the weights with those of the other kind 0 (0 = distance, 1 = texture)."""
        values = self.values.copy()
        values[:, :, 1 - kind, 1] = 0
        return Weights(values, self.tile)

    def shaded(self, shading: Map) -> Weights:
        """Return the weights with gain and offset (rows, columns, 2) of the textures."""
        values = self.values.copy()
        values[:, :, 1, 2:] = shading
        return Weights(values, self.tile)

    def on(self, shape: tuple[int, ...], tile: int) -> Map:
        """Return the values on the tiles of another size of an image, as the kernels take them."""
        rows, columns = (
            np.minimum((np.arange(-(-n // tile)) * tile + tile // 2) // self.tile, k - 1)
            for n, k in zip(shape, self.values.shape, strict=False)
        )
        chosen = self.values[np.ix_(rows, columns)]
        return np.ascontiguousarray(chosen.reshape(*chosen.shape[:2], -1))


def around(values: Array) -> Array:
    """Return sums over each tile (rows, columns, ...) and its eight neighbours."""
    padded = np.pad(values, ((1, 1), (1, 1), *[(0, 0)] * (values.ndim - 2)))
    rows, columns = values.shape[:2]
    return np.asarray(sum(padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)))


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
    tile = tile_of(stride, tile_px)
    w = weights or Weights.alike(b, tile)
    d, t, Hd, Ht, correlation, tiles, sizes, shading, distances, differences = _core.joint_normal_equations(
        a.maps, a.camera, b.maps, np.ascontiguousarray(T_a_b), np.asarray(about, float),
        (max_distance_mm, float(np.cos(max_normal_rad)), stride, tile), w.on(b.texture.shape, tile), residuals, threads,
    )  # fmt: skip
    shape = tiles.shape[:2]
    return Equations(
        d[0], d[1][0], t[0], t[1][0], Hd, Ht, d[4], t[4], d[2] + t[2], d[3], t[3], correlation, tile,
        tiles.reshape(*shape, 2, 6), sizes.reshape(*shape, 2, 2), shading, distances, differences, g_blur=d[5][0],
    )  # fmt: skip


def tile_of(stride: int, tile_px: int) -> int:
    """Return the edge of a tile: the largest multiple of the stride within `tile_px`, at least one."""
    return max(stride, tile_px // stride * stride)


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
    tile = tile_of(stride, tile_px)

    def of(w: Weights) -> tuple[Array, NDArray[np.int64]]:
        by_shift, places = _core.joint_pull(
            a.maps, a.camera, b.maps, np.ascontiguousarray(T_a_b), np.asarray(about, float),
            (max_distance_mm, float(np.cos(max_normal_rad)), stride, tile), w.on(b.texture.shape, tile), threads,
        )  # fmt: skip
        return by_shift, places[0]

    distance, places = of(weights.only(0))
    texture, _ = of(weights.only(1))
    met = places >= 0
    v, u = np.divmod(places[met], b.texture.shape[1])
    return Pull(np.stack([u, v], -1), distance[met], texture[met])
