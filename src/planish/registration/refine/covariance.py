"""Covariance and observability of a refined transform."""

from __future__ import annotations

import numpy as np

from planish.geometry import Array
from planish.registration.refine.information import information, tile_gradients
from planish.registration.refine.solve import Refined
from planish.registration.result import Direction

#: A direction more uncertain than this is held by nothing [mm].
OBSERVABLE_MM = 1.0
#: Standard deviation of a direction that nothing holds [mm].
_NOTHING_MM = 1000.0
#: Directions of the tiles' scatter below this share of the largest are empty but for rounding.
_EMPTY = 1e-12


def noise_covariance(refined: Refined) -> Array:
    """Return the covariance (6, 6) of xi [rad, mm] from the scatter of the tiles' gradients.

    The gradient of the cost is a sum over tiles of about 10 mm; residuals are correlated within a tile and, by the
    window of the surface fit and the smoothing of the texture, over its border. The covariance H^-1 M H^-1, M the
    scatter of the tiles' gradients (White 1980; Liang and Zeger 1986), needs no model of that correlation. H is the
    derivative of the robust gradient (Huber 1981, section 6.4), free of the noise of normals and texture gradients.
    What the blur of the images may displace goes over all tiles and is added as one mode.
    """
    info = information(refined.equations, refined.lever_mm)
    values, vectors = np.linalg.eigh((info.total + info.total.T) / 2)
    held = values > max(values[-1] * 1e-12, 1e-6)
    inverse = vectors[:, held] / values[held]
    scatter = _gradient_scatter(*tile_gradients(refined.equations, info))
    scatter += np.outer(info.blur, info.blur)
    C = inverse @ (vectors[:, held].T @ scatter @ vectors[:, held]) @ inverse.T
    C += _NOTHING_MM**2 * vectors[:, ~held] @ vectors[:, ~held].T
    return C / np.outer(info.scale, info.scale)


def _gradient_scatter(distance: Array, texture: Array) -> Array:
    """Covariance (6, 6) of the sum of both kinds of tiles' gradients (rows, columns, 6)."""
    g = sum(np.sqrt(_shared_with_neighbours(kind)) * kind for kind in (distance, texture))
    n = int(np.any(g != 0, axis=2).sum())
    # n / (n - 6): six parameters were fitted to these gradients (HC1, MacKinnon and White 1985).
    return np.asarray(np.einsum("rci,rcj->ij", g, g) * n / max(n - 6, 1))


def _shared_with_neighbours(g: Array) -> float:
    """Variance of the sum of the tiles' gradients (rows, columns, 6) over that of as many independent ones.

    By the products with the eight neighbours: what the windows carry over a tile's border (Conley 1999). They reach
    equally far whatever the direction, so that one figure serves all six, known that much better.
    """
    rows = g.copy()
    rows[1:] += g[:-1]
    rows[:-1] += g[1:]
    around = rows.copy()
    around[:, 1:] += rows[:, :-1]
    around[:, :-1] += rows[:, 1:]
    own, with_neighbours = (np.einsum("rci,rcj->ij", g, other) for other in (g, around))
    values, vectors = np.linalg.eigh(own)
    held = values > values.max(initial=0) * _EMPTY
    whiten = vectors[:, held] / np.sqrt(values[held])
    ratio = np.trace(whiten.T @ with_neighbours @ whiten) / max(np.count_nonzero(held), 1)
    # Smoothing correlates neighbours positively: what falls below the tiles' own scatter is chance.
    return max(float(ratio), 1.0)


def observability(refined: Refined, covariance: Array, axes: Array | None = None) -> tuple[Direction, ...]:
    """Return the six principal directions of the information, best held first, each with what holds it.

    Rotations are scaled by the overlap's radius, so that all six are in millimetres at the overlap's rim. `axes` (3, 3)
    are those of the overlap (`overlap_axes`), which the motions are named by.
    """
    info = information(refined.equations, refined.lever_mm)
    _, vectors = np.linalg.eigh((info.total + info.total.T) / 2)
    C = covariance * np.outer(info.scale, info.scale)
    directions = []
    for v in vectors.T[::-1]:
        v = v * np.sign(v[np.argmax(np.abs(v))])
        sigma = float(np.sqrt(v @ C @ v))
        share = float(np.clip(v @ info.texture @ v / max(v @ info.total @ v, 1e-30), 0, 1))
        name = _motion(v, axes)
        held = sigma < OBSERVABLE_MM
        directions.append(Direction(tuple(float(x) for x in v), refined.lever_mm, sigma, share, held, name))
    return tuple(directions)


#: Names of the overlap's axes, the longest first.
_AXES = ("the overlap's length", "the overlap's width", "the overlap's normal")
#: A direction is named by an axis from this cosine on (30 degrees).
_NEAR_AXIS = 0.87


def _motion(direction: Array, axes: Array | None) -> str:
    """What moves, in words: the larger part of a direction, rotation or shift, and its axis."""
    rotation, translation = direction[:3], direction[3:]
    turns = bool(np.linalg.norm(rotation) > np.linalg.norm(translation))
    vector = rotation if turns else translation
    vector = vector / np.linalg.norm(vector)
    kind = "a rotation about" if turns else "a shift along"
    if axes is not None:
        cosines = np.abs(axes.T @ vector)
        nearest = int(np.argmax(cosines))
        if cosines[nearest] > _NEAR_AXIS:
            return f"{kind} {_AXES[nearest]}"
    return f"{kind} ({vector[0]:.2f}, {vector[1]:.2f}, {vector[2]:.2f})"
