"""What users know beside their measurements, from files: known points, a robot's transforms, a surface of the part."""

from __future__ import annotations

import csv
import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from planish import storage
from planish.errors import InputError
from planish.files.read_cloud import read_ply_points
from planish.geometry import Array, require_array, require_rigid
from planish.options import Strict
from planish.registration.network.given import Given, RobotTransform, Target
from planish.registration.network.surface_fit import FixedSurface, sample_cloud, sample_mesh

COLUMNS = ("frame", "target", "x_mm", "y_mm", "z_mm", "sigma_mm")
#: Frame of the global coordinates in a file of known points.
WORLD = "world"
MESHES = (".stl", ".obj", ".off", ".ply")


@dataclass(frozen=True)
class GivenFiles:
    """Files of what is known beside the measurements, each of them optional."""

    known_points: Path | None = None
    prior: Path | None = None
    fixed: Path | None = None

    def named(self) -> dict[str, Path]:
        """Return the files that there are, by the name of the field."""
        files = {"known_points": self.known_points, "prior": self.prior, "fixed": self.fixed}
        return {name: file for name, file in files.items() if file is not None}

    def replaced_by(self, other: GivenFiles | None) -> GivenFiles:
        """Return these files, those of `other` in their places."""
        return self if other is None else GivenFiles(**(self.named() | other.named()))


def read_given(files: GivenFiles, measurements: Sequence[str]) -> Given:
    """Return what the files say of these measurements.

    Raises
    ------
    InputError
        Naming file and line or key, what was found and what was expected.
    """
    if files.fixed is not None and files.prior is None and files.known_points is None:
        raise InputError(
            "--fixed", "nothing says where the measurements lie roughly", "--prior or --known-points in its frame"
        )
    world, seen = ({}, {}) if files.known_points is None else read_known_points(files.known_points, measurements)
    robot = {} if files.prior is None else read_prior(files.prior, measurements)
    return Given(world, seen, robot, None if files.fixed is None else read_fixed_surface(files.fixed))


def read_known_points(
    path: Path, measurements: Sequence[str]
) -> tuple[dict[str, Target], dict[str, tuple[Target, ...]]]:
    """Return the targets of a CSV file (COLUMNS) in the global frame, and those each measurement sees in its own.

    Raises
    ------
    InputError
        Naming the line.
    """
    world: dict[str, Target] = {}
    seen: dict[str, dict[str, Target]] = {}
    lines: dict[tuple[str, str], int] = {}
    if WORLD in measurements:
        raise InputError(path, f"a measurement is called '{WORLD}', as the global frame is", "another name for it")
    for line, cells in _rows(Path(path)):
        where, (frame, target) = f"{path}, line {line}", cells[:2]
        if frame != WORLD and frame not in measurements:
            raise InputError(where, f"frame '{frame}'", f"'{WORLD}' or one of {sorted(measurements)}")
        if (frame, target) in lines:
            raise InputError(
                where, f"'{target}' in '{frame}' again, after line {lines[frame, target]}", "one line each"
            )
        lines[frame, target] = line
        item = Target(target, np.array([_number(c, where) for c in cells[2:5]]), _number(cells[5], where))
        if item.sigma_mm <= 0:
            raise InputError(where, f"sigma_mm {cells[5]}", "a standard deviation above 0")
        if frame == WORLD:
            world[target] = item
        else:
            seen.setdefault(frame, {})[target] = item
    for (frame, target), line in lines.items():
        if frame != WORLD and target not in world:
            raise InputError(
                f"{path}, line {line}", f"'{target}' has no global coordinates", f"a line {WORLD},{target}"
            )
    return world, {name: tuple(targets.values()) for name, targets in sorted(seen.items())}


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [(n, [c.strip() for c in row]) for n, row in enumerate(csv.reader(file), 1) if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read ({error})", "a CSV file of known points") from None
    if not rows or tuple(rows[0][1]) != COLUMNS:
        found = ",".join(rows[0][1]) if rows else "nothing"
        raise InputError(f"{path}, line {rows[0][0] if rows else 1}", f"found {found}", ",".join(COLUMNS))
    for line, row in rows[1:]:
        if len(row) != len(COLUMNS):
            raise InputError(f"{path}, line {line}", f"{len(row)} values", f"{len(COLUMNS)}: {','.join(COLUMNS)}")
    return rows[1:]


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(where, f"found '{text}'", "a finite number")
    return value


class _RobotFile(Strict):
    name: str
    T_world_measurement: list[list[float]]
    covariance: list[list[float]] | None = None
    covariance_point_mm: tuple[float, float, float] | None = None
    sigma_mm: float | None = Field(default=None, gt=0)
    sigma_deg: float | None = Field(default=None, gt=0)


class _PriorFile(Strict):
    schema_: Literal["planish.prior/1"] = Field(alias="schema")
    measurements: list[_RobotFile] = Field(min_length=1)


def read_prior(path: Path, measurements: Sequence[str]) -> dict[str, RobotTransform]:
    """Return the approximate transforms of a file `planish.prior/1`.

    Raises
    ------
    InputError
        Naming the key.
    """
    out: dict[str, RobotTransform] = {}
    for i, item in enumerate(_PriorFile.parse(storage.read_json(Path(path)), str(path)).measurements):
        where = f"{path}: measurements.{i}"
        if item.name not in measurements or item.name in out:
            found = f"'{item.name}' twice" if item.name in out else f"name '{item.name}'"
            raise InputError(where, found, f"each of {sorted(measurements)} at most once")
        T = require_rigid(item.T_world_measurement, f"{where}.T_world_measurement")
        point = np.asarray(T[:3, 3] if item.covariance_point_mm is None else item.covariance_point_mm)
        out[item.name] = RobotTransform(T, _robot_covariance(item, where), point)
    return out


def _robot_covariance(item: _RobotFile, where: str) -> Array:
    by_sigmas = item.sigma_mm is not None and item.sigma_deg is not None
    if by_sigmas == (item.covariance is not None):
        raise InputError(where, "no or two statements of the noise", "either sigma_mm and sigma_deg, or covariance")
    if item.sigma_mm is not None and item.sigma_deg is not None:
        return np.diag([np.radians(item.sigma_deg) ** 2] * 3 + [item.sigma_mm**2] * 3)
    C = require_array(item.covariance or [], (6, 6), f"{where}.covariance", "a covariance (6, 6)")
    try:
        np.linalg.cholesky(C)
    except np.linalg.LinAlgError:
        C = np.full((6, 6), np.nan)
    if not np.allclose(C, C.T, rtol=1e-6, atol=0):
        raise InputError(f"{where}.covariance", "not symmetric and positive definite", "a covariance (6, 6)")
    return C


def read_fixed_surface(path: Path) -> FixedSurface:
    """Return a mesh (through trimesh, extra `cad`) or, of a PLY file without faces, a cloud as fixed surface.

    Raises
    ------
    InputError
        Where the file cannot be read or holds no surface, or trimesh is not installed.
    """
    path = Path(path)
    if not path.is_file() or path.suffix.lower() not in MESHES:
        raise InputError(path, "no such file" if not path.is_file() else "an unknown format", f"one of {MESHES}")
    try:
        trimesh: Any = importlib.import_module("trimesh")
    except ImportError:
        raise InputError("trimesh", "is not installed", "pip install planish[cad]") from None
    try:
        mesh = trimesh.load(path, process=False)
        vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(mesh, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
    except Exception as error:
        raise InputError(path, f"cannot be read ({error})", "a whole mesh or cloud") from None
    if len(faces):
        return sample_mesh(vertices, faces)
    points = read_ply_points(path) if path.suffix.lower() == ".ply" else vertices
    points = points[np.isfinite(points).all(1)]
    if len(points) < _LEAST_POINTS:
        raise InputError(path, f"{len(points)} points and no faces", f"a mesh, or a cloud of {_LEAST_POINTS} points")
    return sample_cloud(points)


#: Points that make a surface.
_LEAST_POINTS = 100
