"""Least squares on the grey values around many points at once: where a known figure lies in its window, and how sure.

A window's grey values are g(d) = c + gx dx + gy dy + (m + hx dx + hy dy) S(d; q): a figure S of +-1 with its place and
form q on a light that falls off linearly, plus noise. Every figure here is the same after a turn of 180 degrees about
its centre, and so is its image by any symmetric lens: what the model leaves out (ink that spreads, a lens that is no
Gaussian) does not pull the centre. Levenberg and Marquardt's method, all windows side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array

#: Signature of a figure: offsets (2, n, m) [px] from the windows' middles and q (n, p) to S (n, m) and dS/dq (n, m, p).
#: q begins with the centre's offset (x, y); what has no derivative is given and stays.
Figure = Callable[[Array, Array], tuple[Array, Array]]

#: Steps at most; three to six are the rule.
MAX_STEPS = 20
#: The fit is done when the centre moves by less [px].
DONE_PX = 1e-4
#: Damping at which no step makes the fit better.
HOPELESS = 1e6
#: Windows worked on at a time: 256 of 31 x 31 pixels take 30 MB.
AT_A_TIME = 256
#: Numbers of the light: c, gx, gy, m, hx, hy.
LIGHT = 6


@dataclass(frozen=True)
class Windows:
    """Square cut-outs around points.

    Parameters
    ----------
    middle : ndarray (n, 2)
        Whole pixels in their middle (u, v).
    offset : ndarray (2, m)
        Offsets (u, v) of their pixels from the middle [px].
    grey : ndarray (n, m)
        Grey values.
    weight : ndarray (n, m)
        1 where a pixel counts, else 0.
    """

    middle: NDArray[np.intp]
    offset: Array
    grey: Array
    weight: Array


@dataclass(frozen=True)
class FigureFit:
    """Where the figures lie.

    Parameters
    ----------
    center_px : ndarray (n, 2)
        Their centres (u, v) [px].
    covariance_px2 : ndarray (n, 2, 2)
        Covariance of the centre by what the window's residuals scatter [px^2]; infinite where there is no solution.
    form : ndarray (n, p - 2)
        The other numbers of q.
    contrast : ndarray (n,)
        m [grey levels]: half the step between the figure's two levels.
    noise : ndarray (n,)
        Root mean square of the residuals [grey levels].
    """

    center_px: Array
    covariance_px2: Array
    form: Array
    contrast: Array
    noise: Array


def cut_windows(image: NDArray[Any], points_px: Array, radius: int) -> Windows:
    """Cut squares of 2 radius + 1 pixels out of an image (H, W) around points (n, 2); nothing counts beyond its rim."""
    height, width = image.shape
    middle = np.round(points_px).astype(np.intp)
    steps = np.arange(-radius, radius + 1)
    dv, du = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    u, v = middle[:, :1] + du, middle[:, 1:] + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    grey = image[v.clip(0, height - 1), u.clip(0, width - 1)].astype(float)
    return Windows(middle, np.stack([du, dv]).astype(float), grey, inside.astype(float))


def fit_figures(windows: Windows, figure: Figure, start: Array) -> FigureFit:
    """Fit the figure to every window from q = `start` (n, p)."""
    parts = [
        _fit(
            windows.offset,
            windows.grey[first : first + AT_A_TIME],
            windows.weight[first : first + AT_A_TIME],
            figure,
            start[first : first + AT_A_TIME],
        )
        for first in range(0, max(len(start), 1), AT_A_TIME)
    ]
    q, covariance, contrast, noise = (np.concatenate([part[k] for part in parts]) for k in range(4))
    return FigureFit(windows.middle + q[:, :2], covariance, q[:, 2:], contrast, noise)


def _fit(offset: Array, grey: Array, weight: Array, figure: Figure, start: Array) -> tuple[Array, Array, Array, Array]:
    q, damping = start.astype(float).copy(), np.full(len(start), 1e-3)
    light, cost, J, residual = _evaluate(offset, grey, weight, figure, q)
    active = np.flatnonzero(np.isfinite(cost))
    for _ in range(MAX_STEPS):
        if not len(active):
            break
        weighted = np.swapaxes(J[active], 1, 2) * weight[active, None]
        normal, gradient = weighted @ J[active], weighted @ residual[active, :, None]
        diagonal = np.einsum("nii->ni", normal)
        damped = normal + (damping[active, None] * diagonal + 1e-12)[:, :, None] * np.eye(normal.shape[1])
        step = np.linalg.solve(damped, gradient)[:, LIGHT:, 0]
        trial = q[active]
        trial[:, : step.shape[1]] += step
        new = _evaluate(offset, grey[active], weight[active], figure, trial)
        better = new[1] <= cost[active]
        taken = active[better]
        q[taken] = trial[better]
        for old, now in zip((light, cost, J, residual), new, strict=True):
            old[taken] = now[better]
        damping[active] = np.where(better, damping[active] * 0.1, damping[active] * 10).clip(1e-9, HOPELESS)
        done = better & (np.abs(step[:, :2]).max(1) < DONE_PX)
        active = active[~done & (damping[active] < HOPELESS)]
    return q, *_quality(weight, light, cost, J)


def _evaluate(offset: Array, grey: Array, weight: Array, figure: Figure, q: Array) -> tuple[Array, Array, Array, Array]:
    """Return the best light (n, 6), half the sum of squares (n,), the Jacobian (n, m, 6 + p) and residuals (n, m)."""
    S, dS = figure(np.broadcast_to(offset[:, None], (2, *grey.shape)), q)
    plane = np.broadcast_to(np.stack([np.ones(offset.shape[1]), *offset], -1), (*grey.shape, 3))
    basis = np.concatenate([plane, plane * S[..., None]], -1)
    weighted = np.swapaxes(basis, 1, 2) * weight[:, None]
    normal = weighted @ basis
    scale = 1e-9 * np.einsum("nii->n", normal)[:, None, None] + 1e-300
    light = np.linalg.solve(normal + scale * np.eye(LIGHT), weighted @ grey[..., None])[..., 0]
    residual = grey - (basis @ light[..., None])[..., 0]
    amplitude = (plane @ light[:, 3:, None])[..., 0]
    cost = 0.5 * (weight * residual**2).sum(1)
    return (
        light,
        np.where(np.isfinite(cost), cost, np.inf),
        np.concatenate([basis, amplitude[..., None] * dS], -1),
        residual,
    )


def _quality(weight: Array, light: Array, cost: Array, J: Array) -> tuple[Array, Array, Array]:
    """Return the centre's covariance (n, 2, 2), contrast (n,) and noise (n,)."""
    normal = np.swapaxes(J, 1, 2) @ (weight[..., None] * J)
    freedom = (weight.sum(1) - J.shape[2]).clip(1)
    variance = 2 * cost / freedom
    diagonal = np.sqrt(np.einsum("nii->ni", normal)).clip(1e-150)
    scaled = normal / (diagonal[:, :, None] * diagonal[:, None])
    good = np.isfinite(scaled).all((1, 2)) & (weight.sum(1) > J.shape[2])
    scaled[~good] = np.eye(J.shape[2])
    good &= np.linalg.cond(scaled) < 1e12
    scaled[~good] = np.eye(J.shape[2])
    inverse = np.linalg.inv(scaled) / (diagonal[:, :, None] * diagonal[:, None])
    centre = slice(LIGHT, LIGHT + 2)
    covariance = variance[:, None, None] * inverse[:, centre, centre]
    covariance[~good] = np.inf
    return covariance, light[:, 3], np.sqrt(variance)
