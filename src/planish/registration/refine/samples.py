"""Some residuals of the joint refinement, looked up once: their sizes and their shading follow for any weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array
from planish.measurement import Map
from planish.registration.refine.residuals import TUKEY, TileSums, Weights, tile_of
from planish.registration.refine.sides import JointSide


@dataclass(frozen=True)
class Samples:
    """Every n-th pixel of b against a at one transform.

    Parameters
    ----------
    tile : int
        Edge of a tile of b [px].
    tile_sizes : ndarray (rows, columns, 2, 2)
        Number and sum of the absolute values of the residuals of distance and texture, all alike, in each tile.
    textures : ndarray (3, n) float32
        Textures of a and of b, 1 over the standard deviation of their difference by noise; tile by tile.
    counts : ndarray (rows * columns,) int64
        How many of them each tile has.
    """

    tile: int
    tile_sizes: Array
    textures: Map
    counts: NDArray[np.int64]

    @property
    def points(self) -> int:
        """Number of distances."""
        return int(self.tile_sizes[:, :, 0, 0].sum())

    def sums(self, weights: Weights | None = None) -> TileSums:
        """Return sizes and shading of the residuals at some weights of the same tiles, None = all alike."""
        met = self.counts > 0
        texture_a, texture_b, over_sigma = self.textures
        mean = np.float32(0.5) * (texture_a + texture_b) * over_sigma
        residual = (texture_a - texture_b) * over_sigma
        counted = [mean, over_sigma]
        if weights is not None:
            values = weights.values[:, :, 1].reshape(-1, 4)[met]
            scale, weight, gain, offset = np.repeat(values.T, self.counts[met], axis=1)
            residual = residual - offset * over_sigma - gain * mean
            robust = np.maximum(1 - (residual / (np.float32(TUKEY) * scale)) ** 2, 0) ** 2 * weight
            counted = [mean * robust, over_sigma * robust]
        by_gain, by_offset = counted
        products = (
            by_gain * mean, by_gain * over_sigma, by_offset * over_sigma, by_gain * residual, by_offset * residual,
            np.abs(residual),
        )  # fmt: skip
        of_tiles = np.zeros((6, len(self.counts)))
        if met.any():
            starts = np.concatenate([[0], np.cumsum(self.counts[met])[:-1]])
            for row, product in zip(of_tiles, products, strict=True):
                row[met] = np.add.reduceat(product, starts, dtype=float)
        gains, both, offsets, gain_residual, offset_residual, absolute = of_tiles
        grid = self.tile_sizes.shape[:2]
        sizes = self.tile_sizes.copy()
        sizes[:, :, 1, 1] = absolute.reshape(grid)
        squares = np.stack([gains, both, both, offsets], -1).reshape(*grid, 2, 2)
        residuals = np.stack([gain_residual, offset_residual], -1).reshape(*grid, 2)
        return TileSums(self.tile, sizes, squares, residuals)


def samples(
    a: JointSide,
    b: JointSide,
    T_a_b: Array,
    *,
    max_distance_mm: float,
    max_normal_rad: float,
    stride: int,
    tile_px: int,
    threads: int,
) -> Samples:
    """Return the residuals at every n-th pixel of b against a."""
    tile = tile_of(stride, tile_px)
    options = max_distance_mm, float(np.cos(max_normal_rad)), stride, tile
    sizes, textures, counts = _core.joint_samples(
        a.maps, a.camera, b.maps, np.ascontiguousarray(T_a_b), options, threads
    )
    return Samples(tile, sizes.reshape(*sizes.shape[:2], 2, 2), np.ascontiguousarray(textures.T), counts[0])
