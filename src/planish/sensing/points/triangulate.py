"""From corresponding pixels to points on the organising camera's rays, with their standard deviation."""

from __future__ import annotations

from dataclasses import dataclass, field

from planish import _core
from planish.measurement import Map
from planish.rig import Camera
from planish.sensing.points.correspond import Correspondences, undistortion_shifts


@dataclass(frozen=True)
class TriangulatedPoints:
    """Points on the pixel grid (H, W) of the organising camera.

    Parameters
    ----------
    points_sensor : ndarray (H, W, 3) float32
        Points [mm], each on the ray of its own pixel; NaN where none.
    sigma_mm : ndarray (H, W) float32
        Standard deviation along that ray [mm].
    miss_px : ndarray (H, W) float32
        Distance in the other image between point and corresponding pixel, across the epipolar line [px].
    """

    points_sensor: Map = field(metadata={"unit": "mm"})
    sigma_mm: Map = field(metadata={"unit": "mm"})
    miss_px: Map = field(metadata={"unit": "px"})


def triangulate(pairs: Correspondences, own: Camera, other: Camera, threads: int) -> TriangulatedPoints:
    """Return the point of each pixel's ray that is nearest to the ray of its corresponding pixel.

    Parameters
    ----------
    pairs : Correspondences
        On the pixel grid (H, W) of `own`.
    own, other : Camera
        The organising camera and the other one.
    threads : int
        Number of threads; the result does not depend on it.

    Notes
    -----
    The pixel of the organising camera is exact by definition (it is where the measurement is taken), so all error lies
    in the corresponding pixel: the point stays on the own ray, x(s) = t + s q in the other camera's frame, at the s
    whose image is nearest to n, the corresponding pixel without lens distortion: s (q - n q_z) = n t_z - t along the
    epipolar line. sigma_mm = sigma_px |q| / (motion of the image per s). Computed in single precision, whose rounding
    is that of a pixel of 1e-4 px.
    """
    return TriangulatedPoints(
        *_core.triangulate(
            own.kernel_parameters,
            undistortion_shifts(own, threads),
            other.kernel_parameters,
            pairs.pixel_px,
            pairs.sigma_px,
            threads,
        )
    )
