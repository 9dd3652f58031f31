"""A calibrated camera or projector: from points to pixels and from pixels to rays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planish.errors import InputError
from planish.geometry import Array, invert, require_array, require_rigid

#: Numbers of distortion coefficients OpenCV knows; the tilted sensor (14) is not supported by the kernels.
DISTORTION_LENGTHS = (0, 4, 5, 8, 12)
#: Newton steps of the inverse distortion; real lenses need three to five for UNDISTORT_TOLERANCE.
UNDISTORT_ITERATIONS = 20
#: Residual in normalised coordinates (1e-13 = 1e-9 px at most) at which the inverse distortion is done.
UNDISTORT_TOLERANCE = 1e-13


@dataclass(frozen=True)
class Camera:
    """A calibrated camera, or a projector (a camera with the rays reversed).

    Parameters
    ----------
    K : ndarray (3, 3)
        Camera matrix [px]; pixel (0, 0) is the centre of the first pixel.
    distortion : ndarray (12,)
        k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 of OpenCV; shorter vectors are filled with zeros by `make`.
    size_px : tuple of int
        (width, height) [px].
    T_camera_sensor : ndarray (4, 4)
        Maps points of the sensor frame into the camera frame (x right, y down, z along the view) [mm].
    """

    K: Array
    distortion: Array
    size_px: tuple[int, int]
    T_camera_sensor: Array

    @classmethod
    def make(
        cls,
        K: ArrayLike,
        distortion: ArrayLike,
        size_px: tuple[int, int],
        T_camera_sensor: ArrayLike,
        name: str = "camera",
    ) -> Self:
        """Check the values and fill the distortion with zeros; errors name `name`."""
        expected = "a 3 x 3 camera matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0 [px]"
        matrix = require_array(K, (3, 3), f"{name}.K", expected)
        if min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[1, 0] != 0 or not np.array_equal(matrix[2], [0, 0, 1]):
            raise InputError(f"{name}.K", f"found {matrix.tolist()}", expected)
        if min(size_px) < 1:
            raise InputError(f"{name}.size_px", f"found {tuple(size_px)}", "a (width, height) of 1 px and more")
        coefficients = np.ravel(np.asarray(distortion, float))
        if len(coefficients) == 14 and not coefficients[12:].any():
            coefficients = coefficients[:12]
        if len(coefficients) not in DISTORTION_LENGTHS or not np.isfinite(coefficients).all():
            raise InputError(
                f"{name}.distortion", f"found {coefficients.tolist()}",
                f"{DISTORTION_LENGTHS} coefficients in OpenCV's order (k1 k2 p1 p2 k3 ...)",
            )  # fmt: skip
        full = np.zeros(12)
        full[: len(coefficients)] = coefficients
        return cls(
            matrix,
            full,
            (int(size_px[0]), int(size_px[1])),
            require_rigid(T_camera_sensor, f"{name}.T_camera_sensor"),
        )

    @cached_property
    def center_sensor(self) -> Array:
        """Projection centre (3,) in the sensor frame [mm]."""
        return np.asarray(invert(self.T_camera_sensor)[:3, 3])

    def project(self, points_sensor: NDArray[np.floating]) -> Array:
        """Return pixels (..., 2) of points (..., 3) [mm] in the sensor frame; NaN where not in front of the camera."""
        points = np.asarray(points_sensor, float)
        x = points.reshape(-1, 3) @ self.T_camera_sensor[:3, :3].T + self.T_camera_sensor[:3, 3]
        x[~(x[:, 2] > 0)] = np.nan
        d = self.distort(x[:, :2] / x[:, 2:])
        u = self.K[0, 0] * d[:, 0] + self.K[0, 1] * d[:, 1] + self.K[0, 2]
        pixels = np.stack([u, self.K[1, 1] * d[:, 1] + self.K[1, 2]], -1)
        return pixels.reshape(*points.shape[:-1], 2)

    def rays_sensor(self, pixels: NDArray[np.floating]) -> Array:
        """Return directions (..., 3) in the sensor frame of the rays through pixels (..., 2); camera z component 1."""
        flat = np.asarray(pixels, float).reshape(-1, 2)
        y = (flat[:, 1] - self.K[1, 2]) / self.K[1, 1]
        distorted = np.column_stack([(flat[:, 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0], y])
        normalised = self._undistort(distorted)
        directions = np.column_stack([normalised, np.ones(len(normalised))]) @ self.T_camera_sensor[:3, :3]
        return directions.reshape(*np.shape(pixels)[:-1], 3)

    def distort(self, n: Array) -> Array:
        """Return distorted directions (N, 2) of directions (N, 2) = (x / z, y / z) in the camera's frame."""
        # OpenCV calib3d, "Detailed Description": radial (rational), tangential and thin-prism terms.
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self.distortion
        r2 = (n**2).sum(1)
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        xy = n[:, 0] * n[:, 1]
        dx = n[:, 0] * radial + 2 * p1 * xy + p2 * (r2 + 2 * n[:, 0] ** 2) + s1 * r2 + s2 * r2**2
        dy = n[:, 1] * radial + p1 * (r2 + 2 * n[:, 1] ** 2) + 2 * p2 * xy + s3 * r2 + s4 * r2**2
        return np.stack([dx, dy], -1)

    def _undistort(self, distorted: Array) -> Array:
        # Newton's method; NaN where no ray belongs to the pixel (the distortion is one to one in a limited range).
        n = distorted.copy()
        with np.errstate(all="ignore"):
            for _ in range(UNDISTORT_ITERATIONS):
                residual = distorted - self.distort(n)
                left = np.abs(residual).max(1) > UNDISTORT_TOLERANCE
                if not left.any():
                    return n
                J, r = self.distortion_jacobian(n[left]), residual[left]
                step = np.stack([J[3] * r[:, 0] - J[1] * r[:, 1], J[0] * r[:, 1] - J[2] * r[:, 0]], -1)
                n[left] += step / (J[0] * J[3] - J[1] * J[2])[:, None]
        n[left] = np.nan
        return n

    def distortion_jacobian(self, n: Array) -> Array:
        """Return the derivative of `distort` at directions (N, 2), row by row (4, N)."""
        # `slope` is d radial / d r2.
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self.distortion
        x, y = n.T
        r2 = x * x + y * y
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
        slope = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / below
        cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        prism_x, prism_y = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
        return np.stack(
            [
                radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_x * x,
                cross + prism_x * y,
                cross + prism_y * x,
                radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + prism_y * y,
            ]
        )

    @cached_property
    def kernel_parameters(self) -> Array:
        """All numbers of this camera for the C++ core (29,): fx fy cx cy skew, distortion, R and t row by row."""
        K, T = self.K, self.T_camera_sensor
        return np.concatenate(
            [[K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1]], self.distortion, T[:3, :3].ravel(), T[:3, 3]]
        )

    def to_json(self, frame: Literal["camera", "projector"]) -> dict[str, Any]:
        """Return this camera as it stands in `rig.json`."""
        return {
            "K": self.K.tolist(),
            "distortion": self.distortion.tolist(),
            "size_px": list(self.size_px),
            f"T_{frame}_sensor": self.T_camera_sensor.tolist(),
        }
