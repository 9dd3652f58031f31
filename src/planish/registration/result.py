"""Results of the registration: pairs, measurements, groups, and their file `registration.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from planish import storage
from planish.errors import InputError
from planish.geometry import Array, require_array, require_rigid
from planish.options import Strict
from planish.registration.network.joint import JointCovariances
from planish.registration.network.summary import NetworkSummary

SCHEMA = "planish.registration/1"

Status = Literal["accepted", "refused", "ambiguous"]

#: Share of the information below which a source does not count as holding a direction: alone, it would leave the
#: direction three times as uncertain.
LITTLE = 0.1


@dataclass(frozen=True)
class OverlapError:
    """How well two registered surfaces agree where they overlap; definition in `planish.evaluation.overlap`.

    `sigma_tangential_mm` is the standard deviation of `rms_tangential_mm` that noise alone explains.
    """

    points: int
    min_mm: float
    max_mm: float
    rms_normal_mm: float
    rms_tangential_mm: float | None
    sigma_tangential_mm: float | None


@dataclass(frozen=True)
class RunnerUp:
    """The best consensus that contradicts the chosen one."""

    consensus: int
    log10_false_alarms: float
    T_a_b: Array
    rotation_rad: float
    translation_mm: float


@dataclass(frozen=True)
class Motion:
    """One of several things in a pair that moved differently, and where it is seen.

    Parameters
    ----------
    T_a_b : ndarray (4, 4)
        Its own motion.
    places : int
        Distinct places of the matches that agree with it.
    windows : int
        Windows of the predicted overlap that agree with it.
    log10_false_alarms : float
    stands_still : bool
        Whether it stands at the same pixels in both captures of one sensor.
    box_a_px, box_b_px : tuple of float
        Where it is seen: u_min, v_min, u_max, v_max of the middle 90 % of what agrees, along each axis.
    """

    T_a_b: Array
    places: int
    windows: int
    log10_false_alarms: float
    stands_still: bool
    box_a_px: tuple[float, float, float, float] = field(metadata={"unit": "px"})
    box_b_px: tuple[float, float, float, float] = field(metadata={"unit": "px"})


@dataclass(frozen=True)
class Direction:
    """One eigenvector of the pair's information: what moves, how well it is held, and by what.

    `direction` is a unit vector (6,) [rotation rad scaled by `length_mm`, translation mm] about the covariance point,
    `motion` its larger part in words.
    """

    direction: tuple[float, ...]
    length_mm: float
    sigma_mm: float
    texture_share: float
    observable: bool
    motion: str

    @property
    def held_by(self) -> str:
        """What holds the motion, in words."""
        if not self.observable:
            return f"held by neither geometry nor texture (uncertain by {self.sigma_mm:.1f} mm)"
        share, sigma = self.texture_share, f"({self.sigma_mm:.4f} mm)"
        if share > 1 - LITTLE:
            return f"held by texture {sigma}, not by geometry"
        if share < LITTLE:
            return f"held by geometry {sigma}, not by texture"
        return f"held by both {sigma}, {100 * share:.0f} % of it by texture"


@dataclass(frozen=True)
class PairResult:
    """Everything known about one pair; `T_a_b` maps points of b into a and is None unless accepted.

    `windows` of the overlap that the chosen transform predicts were compared with b, `windows_agreeing` agree;
    `motions` lists all that moved, where several things moved differently.

    Covariances (6, 6) are of xi = [rotation rad, translation mm] with T_a_b = perturb(T_hat, xi, covariance_point_mm);
    the point is given in the frame of a. `covariance_factor` is contained in `covariance_noise`: it exceeds 1 where
    tiles kept out of the fit disagree with it by more than was stated.
    """

    a: str
    b: str
    status: Status
    reason: str
    T_a_b: Array | None = None
    covariance_noise: Array | None = None
    covariance_calibration: Array | None = None
    covariance_point_mm: Array | None = None
    matches: int = 0
    consensus: int = 0
    log10_false_alarms: float = 0.0
    runner_up: RunnerUp | None = None
    observability: tuple[Direction, ...] = ()
    overlap: float | None = None
    overlap_error: OverlapError | None = None
    used: bool = False
    removed_reason: str | None = None
    #: Per rig (by its key) the changes xi (k, 6) of T_a_b by the modes of its covariance, whose outer products add up
    #: to `covariance_calibration`. For the network, not in the JSON; None where a rig states no errors.
    calibration_shifts: Mapping[str, Array] | None = None
    #: Transform (4, 4) of the consensus before refinement, whatever the verdict; not in the JSON.
    T_coarse_a_b: Array | None = None
    #: Pixels (N, 4) of the consensus: (u, v) in a's and (u, v) in b's organising camera; for pictures, not in the JSON.
    consensus_px: Array = field(default_factory=lambda: np.empty((0, 4)))
    #: The same of all matches.
    matches_px: Array = field(default_factory=lambda: np.empty((0, 4)))
    windows: int = 0
    windows_agreeing: int = 0
    motions: tuple[Motion, ...] = ()
    covariance_factor: float = 1.0


@dataclass(frozen=True)
class PlacedMeasurement:
    """A measurement in the world of its group (the frame of the group's reference).

    The covariances are of T_world_measurement about `covariance_point_mm`, the own centroid in world; zero for the
    reference.
    """

    name: str
    file: str
    sha256: str
    group: int
    T_world_measurement: Array
    covariance_noise: Array
    covariance_calibration: Array | None
    covariance_point_mm: Array


@dataclass(frozen=True)
class Group:
    """Measurements that are tied together; the world of the group is the frame of `reference`."""

    id: int
    reference: str


@dataclass(frozen=True)
class Registration:
    """All measurements of a run, tied into one or several groups, and all pairs that were tried."""

    groups: tuple[Group, ...]
    measurements: tuple[PlacedMeasurement, ...]
    pairs: tuple[PairResult, ...]
    options: dict[str, Any]
    versions: dict[str, str]
    network: NetworkSummary = field(default_factory=NetworkSummary)
    #: Covariance of any measurement relative to any other; in `network.h5`, not in the JSON.
    joint: JointCovariances | None = None

    def pair(self, a: str, b: str) -> PairResult:
        """Return the result of a pair by the names of its measurements, in the order in which it was computed."""
        for pair in self.pairs:
            if (pair.a, pair.b) == (a, b):
                return pair
        raise InputError("pair", f"found ({a}, {b})", f"one of {[(p.a, p.b) for p in self.pairs]}")

    def to_json(self) -> dict[str, Any]:
        """Return the content of `registration.json`; nothing in it depends on time, path or machine."""
        return {
            "schema": SCHEMA,
            "units": "mm",
            "versions": self.versions,
            "options": self.options,
            "groups": [asdict(group) for group in self.groups],
            "measurements": [_plain(asdict(item)) for item in self.measurements],
            "pairs": [_pair_to_json(pair) for pair in self.pairs],
            "network": self.network.model_dump(mode="json"),
        }

    def save(self, path: Path) -> None:
        """Write `registration.json`."""
        storage.write_json(Path(path), self.to_json())

    @classmethod
    def load(cls, path: Path) -> Registration:
        """Read `registration.json`; errors name the file."""
        return _RegistrationFile.parse(storage.read_json(Path(path)), str(path)).to_registration(str(path))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return value


_PAIR_KEYS = (
    "a", "b", "status", "reason", "used", "removed_reason", "T_a_b", "covariance_noise", "covariance_calibration",
    "covariance_point_mm", "covariance_factor", "matches", "consensus", "log10_false_alarms", "windows",
    "windows_agreeing", "runner_up", "motions", "observability", "overlap", "overlap_error",
)  # fmt: skip


def _pair_to_json(pair: PairResult) -> dict[str, Any]:
    content = _plain(asdict(pair))
    return {key: content[key] for key in _PAIR_KEYS}


Matrix = list[list[float]]


class _OverlapErrorFile(Strict):
    points: int
    min_mm: float
    max_mm: float
    rms_normal_mm: float
    rms_tangential_mm: float | None
    sigma_tangential_mm: float | None


class _RunnerUpFile(Strict):
    consensus: int
    log10_false_alarms: float
    T_a_b: Matrix
    rotation_rad: float
    translation_mm: float


Box = tuple[float, float, float, float]


class _MotionFile(Strict):
    T_a_b: Matrix
    places: int
    windows: int
    log10_false_alarms: float
    stands_still: bool
    box_a_px: Box
    box_b_px: Box


class _DirectionFile(Strict):
    direction: tuple[float, ...]
    length_mm: float
    sigma_mm: float
    texture_share: float
    observable: bool
    motion: str


class _PairFile(Strict):
    a: str
    b: str
    status: Status
    reason: str
    used: bool
    removed_reason: str | None
    T_a_b: Matrix | None
    covariance_noise: Matrix | None
    covariance_calibration: Matrix | None
    covariance_point_mm: tuple[float, float, float] | None
    covariance_factor: float = Field(ge=1)
    matches: int
    consensus: int
    log10_false_alarms: float
    windows: int = Field(ge=0)
    windows_agreeing: int = Field(ge=0)
    runner_up: _RunnerUpFile | None
    motions: list[_MotionFile]
    observability: list[_DirectionFile]
    overlap: float | None
    overlap_error: _OverlapErrorFile | None


class _PlacedFile(Strict):
    name: str
    file: str
    sha256: str
    group: int
    T_world_measurement: Matrix
    covariance_noise: Matrix
    covariance_calibration: Matrix | None
    covariance_point_mm: tuple[float, float, float]


class _GroupFile(Strict):
    id: int
    reference: str


class _RegistrationFile(Strict):
    schema_: Literal["planish.registration/1"] = Field(alias="schema")
    units: Literal["mm"]
    versions: dict[str, str]
    options: dict[str, Any]
    groups: list[_GroupFile]
    measurements: list[_PlacedFile]
    pairs: list[_PairFile]
    network: NetworkSummary = Field(default_factory=NetworkSummary)

    def to_registration(self, subject: str) -> Registration:
        return Registration(
            self._groups(subject),
            tuple(_placed(m, f"{subject}: {m.name}") for m in self.measurements),
            tuple(_pair(p, f"{subject}: pair {p.a}, {p.b}") for p in self.pairs),
            self.options,
            self.versions,
            self.network,
        )

    def _groups(self, subject: str) -> tuple[Group, ...]:
        names = {item.name for item in self.measurements}
        unknown = {name for pair in self.pairs for name in (pair.a, pair.b)} | {g.reference for g in self.groups}
        if len(names) != len(self.measurements) or unknown - names:
            problem = f"unknown measurements {sorted(unknown - names)}" if unknown - names else "a measurement twice"
            raise InputError(subject, f"found {problem}", "each measurement once, named as in 'measurements'")
        if {item.group for item in self.measurements} != {g.id for g in self.groups}:
            raise InputError(subject, "groups and measurements do not fit", "one group per 'group' of a measurement")
        return tuple(Group(g.id, g.reference) for g in self.groups)


def _covariance(value: Matrix | None, subject: str) -> Array | None:
    return None if value is None else require_array(value, (6, 6), subject, "a covariance (6, 6)")


def _placed(item: _PlacedFile, subject: str) -> PlacedMeasurement:
    return PlacedMeasurement(
        item.name,
        item.file,
        item.sha256,
        item.group,
        require_rigid(item.T_world_measurement, f"{subject}: T_world_measurement"),
        require_array(item.covariance_noise, (6, 6), f"{subject}: covariance_noise", "a covariance (6, 6)"),
        _covariance(item.covariance_calibration, f"{subject}: covariance_calibration"),
        np.asarray(item.covariance_point_mm),
    )


def _pair(item: _PairFile, subject: str) -> PairResult:
    if (item.T_a_b is not None) != (item.status == "accepted"):
        found = "no T_a_b" if item.T_a_b is None else "a T_a_b"
        raise InputError(subject, f"status '{item.status}' with {found}", "a T_a_b exactly where accepted")
    values = item.model_dump()
    for key in ("covariance_noise", "covariance_calibration"):
        values[key] = _covariance(values[key], f"{subject}: {key}")
    if item.covariance_point_mm is not None:
        values["covariance_point_mm"] = np.asarray(item.covariance_point_mm)
    if item.T_a_b is not None:
        values["T_a_b"] = require_rigid(item.T_a_b, f"{subject}: T_a_b")
    if item.runner_up is not None:
        T_a_b = require_rigid(item.runner_up.T_a_b, f"{subject}: runner_up.T_a_b")
        values["runner_up"] = RunnerUp(**{**values["runner_up"], "T_a_b": T_a_b})
    if item.windows_agreeing > item.windows:
        raise InputError(subject, f"{item.windows_agreeing} of {item.windows} windows agree", "at most all")
    values["motions"] = tuple(
        Motion(**{**motion, "T_a_b": require_rigid(motion["T_a_b"], f"{subject}: motions[{i}].T_a_b")})
        for i, motion in enumerate(values["motions"])
    )
    values["observability"] = tuple(Direction(**direction) for direction in values["observability"])
    if item.overlap_error is not None:
        values["overlap_error"] = OverlapError(**values["overlap_error"])
    return PairResult(**values)
