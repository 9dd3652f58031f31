"""Pixels of two devices that show one point of the surface, and how far a rig says they miss each other's ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.rig import Camera, Rig
from planish.rig.derivatives import project_with_derivatives
from planish.rig.parameters import selection

#: Newton steps along a ray to the point nearest to a pixel of the other device: pixels are within 1e-6 after three.
RAY_STEPS = 4


@dataclass(frozen=True)
class PixelPairs:
    """Pairs of pixels that were found without the help of the epipolar geometry.

    Parameters
    ----------
    measurement : str
        Where they were found.
    source : str
        By what.
    own, other : str
        Devices: a camera, and the other camera or "projector".
    own_px, other_px : ndarray (n, 2)
        Where both see the point [px].
    matched_px : ndarray (n, 2)
        The pixel of the other device that the measurement took for it [px].
    points_sensor : ndarray (n, 3)
        Points near it on the ray of `own_px` [mm], as the rig of the measurement gives them.
    sigma_px : ndarray (n,)
        Standard deviation of `other_px` across the epipolar line [px].
    searched : int
        Number of places that were looked at.
    """

    measurement: str
    source: str
    own: str
    other: str
    own_px: Array
    other_px: Array
    matched_px: Array
    points_sensor: Array
    sigma_px: Array
    searched: int

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.sigma_px)

    def at(self, index: NDArray[np.generic]) -> PixelPairs:
        """Return some of the pairs."""
        return replace(
            self,
            own_px=self.own_px[index],
            other_px=self.other_px[index],
            matched_px=self.matched_px[index],
            points_sensor=self.points_sensor[index],
            sigma_px=self.sigma_px[index],
        )

    def with_other(self, other_px: Array) -> PixelPairs:
        """Return the pairs with other pixels in the other device."""
        return replace(self, other_px=other_px)


@dataclass(frozen=True)
class Rows:
    """What a rig says about pairs of pixels.

    Parameters
    ----------
    error_px : ndarray (n,)
        Distance of `other_px` from the epipolar line of `own_px` [px], positive towards larger rows (columns where the
        lines stand upright).
    points_sensor : ndarray (n, 3)
        Point of the own ray whose image is nearest to `other_px` [mm].
    across : ndarray (n, 2)
        Unit vector across the epipolar line in the other image.
    """

    error_px: Array
    points_sensor: Array
    across: Array


def across_epipolar_lines(other: Camera, points_sensor: Array, ray: Array) -> tuple[Array, Array]:
    """Return unit vectors (n, 2) across the epipolar lines, and the motion (n, 2) of the image per mm along the rays.

    The vectors point towards larger rows, or towards larger columns where the lines stand upright.
    """
    _, by_point, _ = project_with_derivatives(other, points_sensor)
    along = np.einsum("nij,nj->ni", by_point, ray)
    across = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=1, keepdims=True)
    main = 1 if np.abs(across[:, 1]).mean() >= np.abs(across[:, 0]).mean() else 0
    return across * np.where(across[:, main : main + 1] < 0, -1.0, 1.0), along


def unit_rays(own: Camera, pixels: Array) -> Array:
    """Return unit vectors (n, 3) along the rays of pixels (n, 2) in the sensor frame."""
    rays = own.rays_sensor(pixels)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def row_errors(pairs: PixelPairs, rig: Rig) -> Rows:
    """Return how far the pairs miss the epipolar lines of `rig`, lens distortion included."""
    own, other = rig.devices[pairs.own], rig.devices[pairs.other]
    ray = unit_rays(own, pairs.own_px)
    distance = ((pairs.points_sensor - own.center_sensor) * ray).sum(1)
    for _ in range(RAY_STEPS):
        points = own.center_sensor + distance[:, None] * ray
        across, along = across_epipolar_lines(other, points, ray)
        left = pairs.other_px - other.project(points)
        distance = distance + (left * along).sum(1) / (along**2).sum(1)
    points = own.center_sensor + distance[:, None] * ray
    return Rows(((pairs.other_px - other.project(points)) * across).sum(1), points, across)


def row_error_derivatives(rig: Rig, pairs: PixelPairs, rows: Rows, names: Sequence[str]) -> Array:
    """Return how the epipolar lines move across themselves (n, k) [px] with the named parameters of the rig.

    Notes
    -----
    A point x of the own ray keeps its own pixel, d pi_own / d x dx = - d pi_own / d a; what it moves along the ray does
    not count, for that is along the epipolar line. The line moves by n (d pi_other / d b + d pi_other / d x dx).
    """
    picks = selection(names, tuple(rig.devices))
    own, other = rig.devices[pairs.own], rig.devices[pairs.other]
    _, own_by_point, own_by_parameter = project_with_derivatives(own, rows.points_sensor)
    _, other_by_point, other_by_parameter = project_with_derivatives(other, rows.points_sensor)
    ray = unit_rays(own, pairs.own_px)
    equations = np.concatenate([own_by_point, ray[:, None]], axis=1)
    change = own_by_parameter @ picks[pairs.own]
    change = np.concatenate([change, np.zeros((len(ray), 1, len(names)))], axis=1)
    moved = -np.linalg.solve(equations, change)
    image = other_by_parameter @ picks[pairs.other] + other_by_point @ moved
    return np.asarray(np.einsum("ni,nik->nk", rows.across, image))
