"""The rig: cameras and projector with their calibration, and its file `rig.json` (schema planish.rig/1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from planish import storage
from planish.errors import InputError
from planish.geometry import Array, invert, require_array
from planish.options import Strict
from planish.rig.camera import Camera
from planish.rig.parameters import PROJECTOR, change_camera, covariance_in_frame, selection, split_name

SCHEMA = "planish.rig/1"
#: Rounding that a covariance in a file may carry, as a share of the standard deviations.
COVARIANCE_TOLERANCE = 1e-9
#: Share of the largest eigenvalue below which a mode of the covariance is rounding.
MODE_SHARE = 1e-14


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

    @property
    def devices(self) -> dict[str, Camera]:
        """Cameras and projector by the names that parameters begin with."""
        return {**self.cameras, **({} if self.projector is None else {PROJECTOR: self.projector})}

    def in_frame_of(self, camera: str) -> Rig:
        """Return the same rig with the frame of one of its cameras as sensor frame; its covariance goes with it."""
        if camera not in self.cameras:
            raise InputError("frame", f"found '{camera}'", f"a camera of the rig: {', '.join(self.cameras)}")
        T_sensor_camera = invert(self.cameras[camera].T_camera_sensor)

        def move(item: Camera) -> Camera:
            return replace(item, T_camera_sensor=item.T_camera_sensor @ T_sensor_camera)

        cameras = {name: move(item) for name, item in self.cameras.items()}
        cameras[camera] = replace(cameras[camera], T_camera_sensor=np.eye(4))
        moved = replace(self, cameras=cameras, projector=None if self.projector is None else move(self.projector))
        if self.covariance is None:
            return moved
        places = {name: item.T_camera_sensor for name, item in self.devices.items()}
        covariance, names = covariance_in_frame(self.covariance, self.covariance_parameters, places, camera)
        return replace(moved, covariance=covariance, covariance_parameters=names)

    def in_sensor_frame_of(self, other: Rig) -> Rig:
        """Return the same rig with the sensor frame in which camera A stands as it does in `other`.

        What refers to the sensor frame of an earlier calibration (a robot's transform, a volume, a truth) stays valid.
        The covariance stays what it is about camera A: its parameters act in the devices' own frames.
        """
        here = self.in_frame_of("A")
        T_A_sensor = other.cameras["A"].T_camera_sensor

        def move(item: Camera) -> Camera:
            return replace(item, T_camera_sensor=item.T_camera_sensor @ T_A_sensor)

        cameras = {name: move(item) for name, item in here.cameras.items()}
        return replace(here, cameras=cameras, projector=None if here.projector is None else move(here.projector))

    def changed(self, change: ArrayLike, names: Sequence[str] | None = None) -> Rig:
        """Return the rig with the named parameters (default: those of the covariance) changed by `change` (n,)."""
        names = self.covariance_parameters if names is None else names
        values = require_array(change, (len(names),), "change", f"{len(names)} numbers, one per parameter")
        picks = selection(names, tuple(self.devices))
        devices = {name: change_camera(item, picks[name] @ values) for name, item in self.devices.items()}
        projector = devices.pop(PROJECTOR, None)
        return replace(self, cameras=devices, projector=projector)

    def modes(self) -> Array:
        """Return the changes (k, n) of the covariance's parameters whose outer products add up to the covariance.

        They are its eigenvectors times the roots of its eigenvalues, after scaling to unit variances: parameters
        differ by many orders of magnitude. Those without any weight are left out.
        """
        if self.covariance is None:
            return np.empty((0, 0))
        sigma = np.sqrt(np.diag(self.covariance))
        scale = np.where(sigma > 0, sigma, 1.0)
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        used = values > MODE_SHARE * max(float(values.max(initial=0.0)), MODE_SHARE)
        return np.asarray((vectors[:, used] * np.sqrt(values[used])).T * scale)

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
        names, n = self.parameters, len(self.parameters)
        twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
        if twice is not None:
            raise InputError(f"{subject}.parameters", f"found '{twice}' twice", "each name once")
        lengths = {len(row) for row in self.matrix}
        if len(self.matrix) != n or lengths != {n}:
            found = f"found {len(self.matrix)} rows of {' or '.join(map(str, sorted(lengths)))} numbers"
            raise InputError(f"{subject}.matrix", found, f"{n} rows of {n} numbers, one per name in 'parameters'")
        matrix = np.array(self.matrix)
        _require_covariance(matrix, names, f"{subject}.matrix")
        return matrix, tuple(names)


def _require_covariance(matrix: Array, names: Sequence[str], subject: str) -> None:
    """Raise an error that names the parameters where a matrix is not symmetric or not positive semidefinite."""
    expected = "a symmetric, positive semidefinite matrix, its units those of the parameters, squared"
    variance = np.diag(matrix)
    worst = int(variance.argmin())
    if variance[worst] < -COVARIANCE_TOLERANCE * np.abs(variance).max():
        raise InputError(subject, f"the variance of {names[worst]} is {variance[worst]:.3g}", expected)
    # Parameters differ by many orders of magnitude: only correlations can be compared with one limit.
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = matrix / np.outer(scale, scale)
    i, j = np.unravel_index(np.abs(correlation - correlation.T).argmax(), matrix.shape)
    if abs(correlation[i, j] - correlation[j, i]) > COVARIANCE_TOLERANCE:
        pair = f"{names[i]} and {names[j]}"
        raise InputError(subject, f"not symmetric: {pair} have {matrix[i, j]:.6g} and {matrix[j, i]:.6g}", expected)
    values, vectors = np.linalg.eigh(correlation)
    if values[0] < -COVARIANCE_TOLERANCE:
        first, second = np.argsort(-np.abs(vectors[:, 0]))[:2]
        raise InputError(
            subject, f"not positive semidefinite: correlations like that of {names[first]} and {names[second]} "
            f"({correlation[first, second]:.3g}) contradict each other or exceed 1", expected,
        )  # fmt: skip


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
        rig = Rig(cameras, projector, *self.covariance.checked(f"{subject}: covariance"))
        for name in rig.covariance_parameters:
            split_name(name, tuple(rig.devices), f"{subject}: covariance.parameters")
        return rig
