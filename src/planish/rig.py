"""The rig: cameras and projector with their calibration, and its file `rig.json` (schema planish.rig/1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from planish import storage
from planish.errors import InputError
from planish.geometry import Array, invert, require_array, require_rigid
from planish.options import Strict

SCHEMA = "planish.rig/1"
#: Numbers of distortion coefficients OpenCV knows; the tilted sensor (14) is not supported by the kernels.
DISTORTION_LENGTHS = (0, 4, 5, 8, 12)
#: Newton steps of the inverse distortion; real lenses need three to five for UNDISTORT_TOLERANCE.
UNDISTORT_ITERATIONS = 20
#: Residual in normalised coordinates (1e-13 = 1e-9 px at most) at which the inverse distortion is done.
UNDISTORT_TOLERANCE = 1e-13
#: Rounding that a covariance in a file may carry, relative to its largest element.
COVARIANCE_TOLERANCE = 1e-9


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
        d = self._distort(x[:, :2] / x[:, 2:])
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

    def _distort(self, n: Array) -> Array:
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
                residual = distorted - self._distort(n)
                left = np.abs(residual).max(1) > UNDISTORT_TOLERANCE
                if not left.any():
                    return n
                J, r = self._distortion_jacobian(n[left]), residual[left]
                step = np.stack([J[3] * r[:, 0] - J[1] * r[:, 1], J[0] * r[:, 1] - J[2] * r[:, 0]], -1)
                n[left] += step / (J[0] * J[3] - J[1] * J[2])[:, None]
        n[left] = np.nan
        return n

    def _distortion_jacobian(self, n: Array) -> Array:
        # Derivative of _distort, row by row (4, N); `slope` is d radial / d r2.
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


@dataclass(frozen=True)
class Rig:
    """Cameras by name ("A", optionally "B"), an optional projector, and the covariance of their parameters.

    Parameters
    ----------
    cameras : dict of Camera
        "A" is always present.
    projector : Camera or None
        The projector, as a camera with the rays reversed.
    covariance : ndarray (n, n) or None
        Covariance of the parameters named in `covariance_parameters`, in that order.
    covariance_parameters : tuple of str
        For example "A.fx", "B.k1", "B.rotation_x" [rad], "projector.translation_z" [mm].
    """

    cameras: dict[str, Camera]
    projector: Camera | None = None
    covariance: Array | None = None
    covariance_parameters: tuple[str, ...] = ()

    def other(self, name: str) -> str | None:
        """Return the name of the camera that is not `name`, or None."""
        return next((key for key in self.cameras if key != name), None)

    def in_frame_of(self, camera: str) -> Rig:
        """Return the same rig with the frame of one of its cameras as sensor frame."""
        T_sensor_camera = invert(self.cameras[camera].T_camera_sensor)

        def move(item: Camera) -> Camera:
            return replace(item, T_camera_sensor=item.T_camera_sensor @ T_sensor_camera)

        cameras = {name: move(item) for name, item in self.cameras.items()}
        cameras[camera] = replace(cameras[camera], T_camera_sensor=np.eye(4))
        return replace(self, cameras=cameras, projector=None if self.projector is None else move(self.projector))

    def to_json(self) -> dict[str, Any]:
        """Return the content of `rig.json`."""
        covariance = None
        if self.covariance is not None:
            covariance = {"parameters": list(self.covariance_parameters), "matrix": self.covariance.tolist()}
        return {
            "schema": SCHEMA,
            "units": "mm",
            "cameras": {name: camera.to_json("camera") for name, camera in self.cameras.items()},
            "projector": None if self.projector is None else self.projector.to_json("projector"),
            "covariance": covariance,
        }

    @classmethod
    def from_json(cls, content: dict[str, Any], subject: str = "rig") -> Rig:
        """Return the rig described by the content of a `rig.json`; errors name `subject`."""
        return _RigFile.parse(content, subject).to_rig(subject)

    def save(self, path: Path) -> None:
        """Write `rig.json`."""
        storage.write_json(Path(path), self.to_json())

    @classmethod
    def load(cls, path: Path) -> Rig:
        """Read `rig.json`; errors name the file."""
        return cls.from_json(storage.read_json(Path(path)), str(path))


class _CameraFile(Strict):
    K: list[list[float]]
    distortion: list[float] = Field(default_factory=list)
    size_px: tuple[int, int]
    T_camera_sensor: list[list[float]]


class _ProjectorFile(Strict):
    K: list[list[float]]
    distortion: list[float] = Field(default_factory=list)
    size_px: tuple[int, int]
    T_projector_sensor: list[list[float]]


class _CamerasFile(Strict):
    A: _CameraFile
    B: _CameraFile | None = None


class _CovarianceFile(Strict):
    parameters: list[str] = Field(min_length=1)
    matrix: list[list[float]]

    def checked(self, subject: str) -> tuple[Array, tuple[str, ...]]:
        n = len(self.parameters)
        expected = f"a symmetric, positive semidefinite matrix ({n}, {n}), one row per name in 'parameters'"
        matrix = require_array(self.matrix, (n, n), f"{subject}.matrix", expected)
        slack = COVARIANCE_TOLERANCE * np.abs(matrix).max()
        if np.abs(matrix - matrix.T).max() > slack or np.linalg.eigvalsh(matrix).min() < -slack:
            raise InputError(f"{subject}.matrix", "found a matrix that is no covariance", expected)
        if len(set(self.parameters)) != n:
            raise InputError(f"{subject}.parameters", "found a name twice", "each name once")
        return matrix, tuple(self.parameters)


class _RigFile(Strict):
    schema_: Literal["planish.rig/1"] = Field(alias="schema")
    units: Literal["mm"] = "mm"
    cameras: _CamerasFile
    projector: _ProjectorFile | None = None
    covariance: _CovarianceFile | None = None

    def to_rig(self, subject: str) -> Rig:
        cameras = {
            name: Camera.make(item.K, item.distortion, item.size_px, item.T_camera_sensor, f"{subject}: {name}")
            for name, item in (("A", self.cameras.A), ("B", self.cameras.B))
            if item is not None
        }
        projector = None
        if (item := self.projector) is not None:
            projector = Camera.make(
                item.K, item.distortion, item.size_px, item.T_projector_sensor, f"{subject}: projector"
            )
        if self.covariance is None:
            return Rig(cameras, projector)
        return Rig(cameras, projector, *self.covariance.checked(f"{subject}: covariance"))
