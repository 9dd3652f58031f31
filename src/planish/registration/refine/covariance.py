"""Covariance and observability of a refined transform."""

from __future__ import annotations

import numpy as np

from planish.geometry import Array
from planish.registration.refine.solve import Refined
from planish.registration.result import Direction

#: A direction more uncertain than this is held by nothing [mm].
OBSERVABLE_MM = 1.0


def noise_covariance(refined: Refined) -> Array:
    """Return the covariance (6, 6) of xi from the scatter of the tiles' gradients.

    The gradient of the cost is a sum over tiles of about 10 mm; residuals are correlated within a tile (interpolation,
    smoothing, window of the surface fit) but hardly between tiles. The covariance H^-1 (sum of g_tile g_tile') H^-1
    with tiles as clusters (White 1980; Liang and Zeger 1986) needs no model of that correlation. H takes the
    texture's information free of gradient noise.
    """
    e = refined.equations
    g = e.tile_gradients[np.any(e.tile_gradients != 0, axis=1)]
    scale = np.array([refined.lever_mm] * 3 + [1.0] * 3)
    H = (e.H_distance + e.H_texture_unbiased) / np.outer(scale, scale)
    g = g / scale
    n = len(g)
    # n / (n - 6): six parameters were fitted to these gradients (HC1, MacKinnon and White 1985).
    meat = g.T @ g * n / max(n - 6, 1)
    inverse = _inverse_where_held(H)
    C = inverse @ meat @ inverse
    return C / np.outer(scale, scale)


def _inverse_where_held(H: Array) -> Array:
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    # Directions that nothing holds get a large but finite variance: 1 m.
    floor = max(values.max() * 1e-12, 1e-6)
    return (vectors / np.maximum(values, floor)) @ vectors.T


def observability(refined: Refined, covariance: Array) -> tuple[Direction, ...]:
    """Return the six principal directions of the information, best held first, each with what holds it.

    Rotations are scaled by the overlap's radius, so that all six are in millimetres at the overlap's rim.
    """
    e = refined.equations
    scale = np.array([refined.lever_mm] * 3 + [1.0] * 3)
    H_t = e.H_texture_unbiased / np.outer(scale, scale)
    H = e.H_distance / np.outer(scale, scale) + H_t
    _, vectors = np.linalg.eigh((H + H.T) / 2)
    C = covariance * np.outer(scale, scale)
    directions = []
    for v in vectors.T[::-1]:
        v = v * np.sign(v[np.argmax(np.abs(v))])
        sigma = float(np.sqrt(v @ C @ v))
        share = float(np.clip(v @ H_t @ v / max(v @ H @ v, 1e-30), 0, 1))
        directions.append(Direction(tuple(float(x) for x in v), refined.lever_mm, sigma, share, sigma < OBSERVABLE_MM))
    return tuple(directions)
