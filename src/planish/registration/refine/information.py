"""What distances and textures together say about a change of the transform, and about which directions they say it.

The gradient of a noisy surface or texture points somewhere even where the true one vanishes: J'J then claims a hold
that does not exist. The product of both sides' gradients, whose noise is independent, is free of that. The joint cost
is solved with the latter, and distances count along each direction by the share of their J'J that is no noise: along a
pipe or a plane that share vanishes, and what the rim of a surface does to its normals pulls nothing there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.geometry import Array
from planish.registration.refine.residuals import Equations

#: Directions of the distances' information below this share of the largest are empty but for rounding.
_EMPTY = 1e-12


@dataclass(frozen=True)
class Information:
    """Gradient and curvature of the joint cost; rotations scaled by `scale`, so that all are per mm at the rim.

    Parameters
    ----------
    scale : ndarray (6,)
        Scaled xi = scale * xi.
    trust : ndarray (6, 6)
        Acts on the gradient of the distances.
    gradient : ndarray (6,)
        Expected to vanish at the solution.
    texture, total : ndarray (6, 6)
        Its expected derivative by the scaled xi, by the texture alone and in all.
    noise : ndarray (6, 6)
        Covariance of the gradient if weights are right and values independent.
    blur : ndarray (6,)
        Change of the gradient by one standard deviation of the images' blur.
    """

    scale: Array
    trust: Array
    gradient: Array
    texture: Array
    total: Array
    noise: Array
    blur: Array


def information(e: Equations, lever_mm: float, min_slope: float = 0.0, afar: bool = False) -> Information:
    """Return the information of normal equations; robust slopes count at least `min_slope`.

    `afar`, where the textures do not lie upon each other yet, their gradients have little in common: steps by that
    would go much too far, and are made by J'J.
    """
    scale = np.array([lever_mm] * 3 + [1.0] * 3)
    outer = np.outer(scale, scale)
    slope_distance, slope_texture = max(e.slope_distance, min_slope), max(e.slope_texture, min_slope)
    trust, distance = _trusted(e.H_distance / outer, e.H_distance_unbiased / outer)
    texture = slope_texture * (e.H_texture if afar else e.H_texture_unbiased) / outer
    return Information(
        scale,
        trust,
        trust @ (e.g_distance / scale) + e.g_texture / scale,
        texture,
        slope_distance * distance + texture,
        distance + e.H_texture / outer,
        slope_distance * trust @ (e.g_blur / scale),
    )


def tile_gradients(e: Equations, info: Information) -> tuple[Array, Array]:
    """Return the tiles' gradients (rows, columns, 6) of distance and texture, scaled; all sum up to `info.gradient`."""
    distance, texture = np.moveaxis(e.tile_gradients / info.scale, 2, 0)
    return np.asarray(distance @ info.trust.T), np.asarray(texture)


def held_directions(info: Information, max_sigma_mm: float) -> tuple[Array, Array]:
    """Return the directions (6, m) of xi that are known better than `max_sigma_mm`, and their curvature (m,)."""
    values, vectors = np.linalg.eigh((info.total + info.total.T) / 2)
    noise = np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", vectors, info.noise, vectors), 0))
    held = values * max_sigma_mm > noise
    return vectors[:, held] / info.scale[:, None], values[held]


def _trusted(plain: Array, unbiased: Array) -> tuple[Array, Array]:
    """Return the matrix that weights a gradient by the share of its information that is no noise, and what is left.

    In the directions u with u' plain u = 1 that also diagonalise `unbiased`, its share s weights the gradient's part:
    of all weights that one gives the least variance, the part's sensitivity being s and its own variance 1.
    """
    values, vectors = np.linalg.eigh(plain)
    full = values > values[-1] * _EMPTY
    whiten = vectors[:, full] / np.sqrt(values[full])
    share, turned = np.linalg.eigh(whiten.T @ unbiased @ whiten)
    share = np.clip(share, 0, 1)
    U = whiten @ turned
    back = plain @ U
    return (back * share) @ U.T, (back * share**2) @ back.T
