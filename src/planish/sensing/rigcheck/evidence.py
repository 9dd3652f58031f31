"""Row errors of all places together: their noise, their outliers, and what could have made them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.rig import Rig
from planish.sensing.rigcheck.orientation import external_names, moved_device, orientation_basis
from planish.sensing.rigcheck.pairs import PixelPairs, row_error_derivatives, row_errors

#: What the check itself may be wrong by, as a pattern that varies slowly over the image, rms [px].
FLOOR_PX = 0.01
#: Shares of the degrees 0 to 3 of such patterns in their variance.
DEGREE_SHARES = (0.4, 0.3, 0.2, 0.1)
#: Degree of each pattern.
DEGREES = tuple(degree for degree in range(len(DEGREE_SHARES)) for _ in range(degree + 1))
#: Robust fits: the scale starts at the largest error, falls by this factor to the noise; Tukey's limit in sigmas.
SCALE_FACTOR, TUKEY = 1.5, 5.0
#: The noise is not taken for less than this [px]: interpolation and rounding.
LEAST_SIGMA_PX = 0.005
FINAL_STEPS = 8


@dataclass(frozen=True)
class Evidence:
    """Row errors of n places in all measurements, and how they change with what could be wrong.

    Parameters
    ----------
    error_px : ndarray (n,)
        Row errors [px], of pairs that look for points of the moved device in the other one with the sign turned.
    sigma_px : ndarray (n,)
        Standard deviation of each, scatter of the places included [px].
    weight : ndarray (n,)
        0 for outliers, 1 for places without doubt.
    by_orientation : ndarray (n, 5)
        Derivatives by the changes of the relative orientation [px / rad].
    by_rig : ndarray (n, m)
        Derivatives by the parameters of the rig's covariance.
    shapes : ndarray (n, 10)
        Slow patterns over the image, each with the rms [px] that DEGREE_SHARES gives it in a total of 1 px.
    floor_px : ndarray (10,)
        Standard deviation of each slow pattern's amplitude by what neither orientation nor covariance of the rig makes.
    """

    error_px: Array
    sigma_px: Array
    weight: Array
    by_orientation: Array
    by_rig: Array
    shapes: Array
    floor_px: Array

    @property
    def information(self) -> Array:
        """Inverse variance (n,) of each place; 0 for outliers."""
        return np.asarray(self.weight / self.sigma_px**2)

    @property
    def kept(self) -> int:
        """Number of places that are no outliers."""
        return int((self.weight > 0).sum())


def gather(pairs: Sequence[PixelPairs], rig: Rig, names: Sequence[str]) -> Evidence:
    """Return the row errors of pairs with one and the same two devices, differentiated by the named parameters too."""
    moved, fixed = moved_device(pairs[0].own, pairs[0].other)
    basis, external = orientation_basis(rig, moved, fixed), external_names(moved)
    errors, sigmas, orientation, parameters, shapes = [], [], [], [], []
    for item in pairs:
        rows = row_errors(item, rig)
        # What lies too low in one device lies too high in the other: one sign for measurements organised on either.
        sign = 1.0 if item.other == moved else -1.0
        errors.append(sign * rows.error_px)
        sigmas.append(np.maximum(item.sigma_px, LEAST_SIGMA_PX))
        orientation.append(sign * row_error_derivatives(rig, item, rows, external) @ basis)
        parameters.append(sign * row_error_derivatives(rig, item, rows, names))
        shapes.append(slow_patterns(item.own_px, rig.devices[item.own].size_px))
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    J, Phi = np.concatenate(orientation), np.concatenate(shapes)
    scatter, weight = _noise_and_outliers(error, sigma, np.column_stack([J, Phi]))
    return Evidence(
        error, np.hypot(sigma, scatter), weight, J, np.concatenate(parameters), Phi, np.full(Phi.shape[1], FLOOR_PX)
    )


def slow_patterns(pixels: Array, size_px: tuple[int, int]) -> Array:
    """Return products of Legendre polynomials up to degree 3 over the image (n, 10) with the rms of DEGREE_SHARES."""
    u, v = (2 * pixels[:, k] / (size_px[k] - 1) - 1 for k in (0, 1))
    columns = []
    for degree, share in enumerate(DEGREE_SHARES):
        for i in range(degree + 1):
            j = degree - i
            # The mean square of the Legendre polynomial of degree i over [-1, 1] is 1 / (2 i + 1).
            size = np.sqrt(share / (degree + 1) * (2 * i + 1) * (2 * j + 1))
            columns.append(size * _legendre(i, u) * _legendre(j, v))
    return np.stack(columns, -1)


def _legendre(degree: int, x: Array) -> Array:
    return np.asarray(np.polynomial.legendre.legval(x, np.eye(degree + 1)[degree]))


def _noise_and_outliers(error: Array, sigma: Array, design: Array) -> tuple[float, Array]:
    """Return the scatter [px] of the places beyond their own sigma, and weights (n,), 0 for outliers.

    Notes
    -----
    Graduated non-convexity (Blake and Zisserman 1987; Yang et al. 2020): the Geman-McClure weight s^4 / (s^2 + r^2)^2
    with a scale s that falls from the largest error to the noise finds what most places agree in without a start.
    """
    scale = np.abs(design).max(0)
    A = design / np.where(scale > 0, scale, 1)
    s = max(float(np.abs(error).max()), LEAST_SIGMA_PX)
    left, stop = error, max(float(np.median(sigma)), LEAST_SIGMA_PX)
    while s > stop:
        w = s**4 / (s**2 + left**2) ** 2 / (sigma**2 + s**2)
        left = error - A @ _solve(A, error, w)
        s /= SCALE_FACTOR
    scatter, weight = 0.0, np.ones(len(error))
    for _ in range(FINAL_STEPS):
        scatter = _scatter(left, sigma, A.shape[1])
        z = left / np.hypot(sigma, scatter) / TUKEY
        weight = np.where(np.abs(z) < 1, (1 - z**2) ** 2, 0.0)
        left = error - A @ _solve(A, error, weight / (sigma**2 + scatter**2))
    return scatter, weight


def _solve(A: Array, b: Array, weight: Array) -> Array:
    normal = (A * weight[:, None]).T @ A
    # A small ridge: orientation and slow patterns overlap.
    ridge = 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal + ridge, (A * weight[:, None]).T @ b))


def _scatter(left: Array, sigma: Array, parameters: int) -> float:
    """Return what makes the median of |left| / sigma that of a normal distribution (bisection)."""
    used = max(1 - parameters / len(left), 0.25)

    def typical(scatter: float) -> float:
        return float(1.4826 * np.median(np.abs(left) / np.hypot(sigma, scatter))) / np.sqrt(used)

    if typical(0.0) <= 1:
        return 0.0
    low, high = 0.0, float(np.abs(left).max()) * 2 / np.sqrt(used)
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if typical(middle) > 1 else (low, middle)
    return 0.5 * (low + high)


def normal_equations(
    evidence: Evidence, design: Array, nuisance: Sequence[tuple[Array, NDArray[np.floating]]]
) -> tuple[Array, Array]:
    """Return A = design' V^-1 design and b = design' V^-1 error.

    Parameters
    ----------
    design : ndarray (n, k)
        Derivatives by what is looked for.
    nuisance : sequence of (ndarray (n, j), ndarray (j, j))
        What else acts: derivatives B and factor L of its covariance L L'; V = noise + sum B L L' B'.

    Notes
    -----
    Woodbury: V^-1 = W - W B (1 + B' W B)^-1 B' W.
    """
    W = evidence.information[:, None]
    A, b = design.T @ (W * design), design.T @ (W[:, 0] * evidence.error_px)
    parts = [B @ L for B, L in nuisance if L.size]
    if not parts:
        return A, b
    B = np.column_stack(parts)
    cross = B.T @ (W * design)
    inner = np.eye(B.shape[1]) + B.T @ (W * B)
    A -= cross.T @ np.linalg.solve(inner, cross)
    b -= cross.T @ np.linalg.solve(inner, B.T @ (W[:, 0] * evidence.error_px))
    return A, b
