"""Do the textures correlate in small tiles, each by itself? A highlight counts no more there than its area.

The correlation of whole textures is ruled by what is strongest: where one measurement shows a highlight and the other
none, the rest is not heard. Tiles as wide as the low-pass that took the shading, freed of their means, hold nothing
that is coarser: what light leaves on a waved surface agrees wherever the waves agree, and is no texture.
"""

from __future__ import annotations

import numpy as np

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.refine.residuals import Equations, Weights, equations
from planish.registration.refine.sides import JointSide
from planish.registration.refine.solve import Refined, RefineOptions


def local_correlation_sigma(
    a: JointSide, b: JointSide, refined: Refined, shading_px: float, options: RefineOptions, threads: int = 1
) -> float:
    """Return the mean correlation of the tiles, by area, in standard deviations of that of unrelated textures.

    Notes
    -----
    The correlation of n independent values has the variance 1 / n, whatever their size (of spherical vectors). n pixels
    hold n / p of them, p the pixels per value of the whole textures; these may be finer where they are strong than
    elsewhere, so that a whole tile counts as one value at most: sum(n r) has less than the variance p sum(n).
    """
    tile = max(_LEAST_TILE_PX, round(shading_px))
    e = equations(
        a, b, refined.T_a_b, refined.about, Weights.alike(b, tile), max_distance_mm=max(options.max_distance_mm),
        max_normal_rad=options.max_normal_rad, stride=1, tile_px=tile, residuals=True, threads=threads,
    )  # fmt: skip
    number = e.tile_sizes[:, :, 1, 0]
    per_value = max(float(np.sqrt(a.pixels_per_value * b.pixels_per_value)), float(tile**2))
    total = float((number * _correlations(e)).sum())
    return total / float(np.sqrt(per_value * max(number.sum(), 1.0)))


#: Fewer pixels have no mean to be freed of.
_LEAST_TILE_PX = 4


def _correlations(e: Equations) -> Array:
    """Correlation (rows, columns) of both textures within each tile, about their means there; 0 where there is none.

    By the sums of the residual r = (a - b) / sigma and of the mean m = (a + b) / (2 sigma).
    """
    r_r = _tile_sums(np.nan_to_num(e.differences) ** 2, e.tile)
    m_m, m_q, q_q, m_r, q_r = (e.tile_shading[..., k] for k in (12, 13, 15, 16, 17))
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_a, mean_b = ((m_q + sign * q_r / 2) / q_q for sign in (1, -1))
        a_a = m_m + m_r + r_r / 4 - mean_a**2 * q_q
        b_b = m_m - m_r + r_r / 4 - mean_b**2 * q_q
        r = (m_m - r_r / 4 - mean_a * mean_b * q_q) / np.sqrt(a_a * b_b)
    return np.where((a_a > 0) & (b_b > 0), np.clip(np.nan_to_num(r), -1, 1), 0.0)


def _tile_sums(values: Map, tile: int) -> Array:
    rows, columns = (-(-n // tile) for n in values.shape)
    padded = np.zeros((rows * tile, columns * tile))
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(rows, tile, columns, tile).sum((1, 3)))
