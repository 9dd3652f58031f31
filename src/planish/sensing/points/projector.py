"""Points from one camera and a calibrated projector: where the camera's ray meets the decoded projector position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.measurement import Map
from planish.rig import Camera
from planish.sensing.decode import PhaseMap
from planish.sensing.patterns.entries import Axis
from planish.sensing.points.correspond import undistortion_shifts
from planish.sensing.points.triangulate import TriangulatedPoints

_AXES: tuple[Axis, Axis] = ("u", "v")
_ABSENT: Map = np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class ProjectorPoints(TriangulatedPoints):
    """Points (H, W) from a camera and the projector.

    Parameters
    ----------
    miss_px : ndarray (H, W) float32
        With both axes decoded: the decoded place less the point's own in the projector, across the image of the ray
        [projector px]. NaN with one axis, for that leaves nothing over.
    miss_sigma_px : ndarray (H, W) float32
        Its standard deviation [projector px].
    """

    miss_sigma_px: Map = field(metadata={"unit": "projector px"})

    def contradiction(self, allowed_px: float, sigmas: float) -> NDArray[np.bool_]:
        """Return where (H, W) bool both axes contradict each other by more than `allowed_px` and noise explain."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(self.miss_px) > allowed_px + sigmas * self.miss_sigma_px)


def intersect(
    phases: Mapping[Axis, PhaseMap],
    primary: Axis,
    own: Camera,
    projector: Camera,
    threads: int,
    pixels: NDArray[np.intp] | None = None,
) -> ProjectorPoints:
    """Return the point of each pixel's ray whose image in the projector has the decoded position.

    Parameters
    ----------
    phases : dict of PhaseMap
        The camera's positions (H, W) along one or both projector axes.
    primary : "u" or "v"
        Pixels without a position along this axis have no point; the other axis adds to it where it is known.
    own, projector : Camera
        Their calibration, with lens distortion.
    threads : int
        Number of threads; the result does not depend on it.
    pixels : ndarray (h, w) int or None
        Flat indices of the pixels that are wanted, -1 for none; the result has this shape. Default: all pixels.

    Notes
    -----
    The image of the ray x(s) = t + s q in the undistorted projector is the line (t x q) n = 0 (Hartley & Zisserman
    2004, 9.2); n(l) = foot + l e on it is found by Gauss-Newton steps on sum ((x_i(n(l)) - p_i) / sigma_i)^2 over the
    decoded axes i, x_i with the projector's distortion. Then sigma_l^-2 = sum (d x_i / d l)^2 / sigma_i^2, and
    sigma_mm = sigma_l |q| / |d n / d s|.
    """
    shifts = undistortion_shifts(own, threads)
    u, v = (_maps(phases.get(axis), pixels) for axis in _AXES)
    if pixels is not None:
        shifts = _shifts_of(pixels, shifts, own.size_px[0])
    width, height = projector.size_px
    parameters = own.kernel_parameters, shifts, projector.kernel_parameters
    return ProjectorPoints(*_core.intersect(*parameters, width, height, *u, *v, _AXES.index(primary), threads))


def _maps(phase: PhaseMap | None, pixels: NDArray[np.intp] | None) -> tuple[Map, Map]:
    if phase is None:
        return _ABSENT, _ABSENT
    if pixels is None:
        return phase.position_px, phase.sigma_px
    taken = phase.at(pixels)
    taken.position_px[pixels < 0] = np.nan
    return taken.position_px, taken.sigma_px


def _shifts_of(pixels: NDArray[np.intp], shifts: Map, width: int) -> Map:
    # The kernel adds column and row of its own map: here that of the list, which is taken off again.
    place = np.stack([pixels % width, pixels // width], -1) - np.stack([*np.indices(pixels.shape)][::-1], -1)
    undistorted = place if shifts.size == 0 else place + shifts.reshape(-1, 2)[pixels]
    return np.ascontiguousarray(undistorted, np.float32)
