"""The figures that boards are made of, as their images look through a lens: where two edges cross, and a disc."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from planish.geometry import Array

#: Blurs beyond make no difference, or none that fits a window [px].
LEAST_BLUR_PX, LARGEST_BLUR_PX = 0.05, 50.0


def _blur(log: Array) -> Array:
    return np.exp(np.clip(log, np.log(LEAST_BLUR_PX), np.log(LARGEST_BLUR_PX)))


def crossing(offset: Array, q: Array) -> tuple[Array, Array]:
    """Return S and its derivatives where two straight edges cross: -1 and +1 in turn, blurred by a Gaussian.

    Parameters
    ----------
    offset : ndarray (2, n, m)
        Offsets of the pixels from the window's middle [px].
    q : ndarray (n, 7)
        Centre x, y [px], directions of the edges' normals [rad], log of the blur's standard deviation [px], curvatures
        of the edges [1/px].

    Returns
    -------
    S : ndarray (n, m)
        In -1 ... 1; S = +1 where both normals point.
    derivatives : ndarray (n, m, 5)
        By all but the curvatures, which are given.

    Notes
    -----
    S = E(a) E(b), E(a) = erf(a / (sqrt(2) s)), a and b the distances from the edges: exact for edges at right angles.
    """
    dx, dy = offset[0] - q[:, 0, None], offset[1] - q[:, 1, None]
    s = _blur(q[:, 4, None])
    edges = []
    for k in (2, 3):
        cos, sin = np.cos(q[:, k, None]), np.sin(q[:, k, None])
        along, bend = cos * dy - sin * dx, q[:, 3 + k, None]
        a = cos * dx + sin * dy - 0.5 * bend * along**2
        slope = np.sqrt(2 / np.pi) / s * np.exp(-0.5 * (a / s) ** 2)
        edges.append((a, erf(a / (np.sqrt(2) * s)), slope, cos, sin, along))
    (a, Ea, ga, cos_a, sin_a, along_a), (b, Eb, gb, cos_b, sin_b, along_b) = edges
    derivatives = np.stack(
        [
            -cos_a * ga * Eb - cos_b * gb * Ea,
            -sin_a * ga * Eb - sin_b * gb * Ea,
            along_a * ga * Eb,
            along_b * gb * Ea,
            -a * ga * Eb - b * gb * Ea,
        ],
        -1,
    )
    return Ea * Eb, derivatives


def disc(offset: Array, q: Array) -> tuple[Array, Array]:
    """Return S and its derivatives of an ellipse: +1 outside, -1 inside, blurred by a Gaussian.

    Parameters
    ----------
    offset : ndarray (2, n, m)
        Offsets of the pixels from the window's middle [px].
    q : ndarray (n, 6)
        Centre x, y [px]; L = [[l1, l2], [0, l3]] [1/px] with the ellipse where |L d| = 1; log of the blur's standard
        deviation [px].

    Returns
    -------
    S : ndarray (n, m)
        In -1 ... 1.
    derivatives : ndarray (n, m, 6)
        By all of q, to first order in the distance from the edge.

    Notes
    -----
    S = erf(a / (sqrt(2) s)), a = (|L d| - 1) / |grad |L d||: the distance from the edge to first order.
    """
    dx, dy = offset[0] - q[:, 0, None], offset[1] - q[:, 1, None]
    l1, l2, l3 = (q[:, k, None] for k in (2, 3, 4))
    s = _blur(q[:, 5, None])
    w1, w2 = l1 * dx + l2 * dy, l3 * dy
    r = np.hypot(w1, w2).clip(1e-6)
    rx, ry = l1 * w1 / r, (l2 * w1 + l3 * w2) / r
    steep = np.hypot(rx, ry).clip(1e-6)
    a = (r - 1) / steep
    g = np.sqrt(2 / np.pi) / s * np.exp(-0.5 * (a / s) ** 2)
    per = g / steep
    derivatives = np.stack([-rx * per, -ry * per, w1 * dx / r * per, w1 * dy / r * per, w2 * dy / r * per, -a * g], -1)
    return erf(a / (np.sqrt(2) * s)), derivatives
