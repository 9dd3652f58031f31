"""The file `rig_calibration.json` (schema planish.calibration/1): what a calibrated rig rests on, figures only."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field

from planish import storage
from planish.options import Strict
from planish.sensing.calibrate.judge.advice import advice
from planish.sensing.calibrate.judge.expected_error import ExpectedError, expected_errors, map_rms
from planish.sensing.calibrate.judge.views import depths_mm, placements
from planish.sensing.calibrate.result import Calibration
from planish.sensing.capture.board import Board

SCHEMA = "planish.calibration/1"

Matrix = tuple[tuple[float, ...], ...]


class ModelEntry(Strict):
    """The lens model of one device."""

    name: str
    coefficients: tuple[str, ...]
    left_out_rms_px: dict[str, float | None]
    sentence: str


class DeviceEntry(Strict):
    """What the residuals of one device say."""

    size_px: tuple[int, int]
    views: int
    points: int
    outliers: int
    rms_px: float | None
    left_out_rms_px: float | None
    noise_px: float
    model: ModelEntry | None


class ResidualEntry(Strict):
    """One view in one device; `outliers` are numbers of board points."""

    device: str
    through: str | None
    points: int
    rms_px: float | None
    outliers: tuple[int, ...]


class ViewEntry(Strict):
    """One view of the board."""

    name: str
    images: dict[str, str]
    T_A_board: Matrix
    distance_mm: float
    tilt_rad: float
    residuals: tuple[ResidualEntry, ...]


class MissedEntry(Strict):
    """An image that was not used."""

    image: str
    reason: str


class ScaleEntry(Strict):
    """By how much lengths differ from those that the pitch of the board file gives (a share of 1)."""

    value: float
    sigma: float


class ErrorEntry(Strict):
    """Expected 3D error on a plane at the working distance, rms over the map."""

    own: str
    other: str
    distance_mm: float
    form_rms_mm: float | None
    scale_rms_mm: float | None
    sensor_rms_mm: float | None
    scale_sigma: float


class FindingEntry(Strict):
    """As `planish.measurement.Finding`."""

    quantity: str
    value: float | None
    sigma: float | None
    unit: str
    source: str
    warning: str


class CalibrationFile(Strict):
    """The content of the file."""

    schema_: Literal["planish.calibration/1"] = Field(alias="schema")
    units: Literal["mm"] = "mm"
    versions: dict[str, str]
    options: dict[str, Any]
    board: Board
    scale: ScaleEntry
    devices: dict[str, DeviceEntry]
    expected_error: tuple[ErrorEntry, ...]
    findings: tuple[FindingEntry, ...]
    advice: tuple[str, ...]
    height_mm: tuple[float | None, ...] | None
    views: tuple[ViewEntry, ...]
    missed: tuple[MissedEntry, ...]

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        versions: Mapping[str, str] | None = None,
        errors: Sequence[ExpectedError] | None = None,
    ) -> Self:
        """Return the content for a calibration.

        Parameters
        ----------
        calibration : Calibration
            What is written.
        versions : mapping of str
            Versions that the result depends on.
        errors : sequence of ExpectedError or None
            Those of `expected_errors`, where the caller has them already.
        """
        errors = expected_errors(calibration) if errors is None else errors
        height = calibration.height_mm
        content = {
            "schema": SCHEMA,
            "versions": dict(versions or {}),
            "options": calibration.options,
            "board": calibration.observations.board.model_dump(mode="json", by_alias=True),
            "scale": {"value": calibration.scale[0], "sigma": calibration.scale[1]},
            "devices": {device: _device(calibration, device) for device in calibration.rig.devices},
            "expected_error": [_error(calibration, error) for error in errors],
            "findings": [asdict(finding) for finding in calibration.findings],
            "advice": list(advice(calibration, errors)),
            "height_mm": None if height is None else [_number(value) for value in height],
            "views": _views(calibration),
            "missed": [{"image": i, "reason": r} for i, r in calibration.observations.missed.items()],
        }
        return cls.parse(content, "calibration")

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the file; errors name it."""
        return cls.parse(storage.read_json(Path(path)), str(path))

    def save(self, path: Path) -> None:
        """Write the file."""
        storage.write_json(Path(path), self.model_dump(mode="json", by_alias=True))


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _device(calibration: Calibration, device: str) -> dict[str, Any]:
    own = [r for r in calibration.residuals if r.device == device]
    points = sum(int((~r.outlier).sum()) for r in own)
    model = calibration.models.get(device)
    left_out = calibration.left_out_rms_px.get(device)
    return {
        "size_px": calibration.rig.devices[device].size_px,
        "views": len({r.view for r in own if (~r.outlier).any()}),
        "points": points,
        "outliers": sum(int(r.outlier.sum()) for r in own),
        "rms_px": _number(calibration.rms_px(device)) if points else None,
        "left_out_rms_px": None if left_out is None else _number(left_out),
        "noise_px": calibration.noise_px[device],
        "model": None
        if model is None
        else {
            "name": model.name,
            "coefficients": list(model.coefficients),
            "left_out_rms_px": {name: _number(value) for name, value in model.left_out_rms_px.items()},
            "sentence": model.sentence,
        },
    }


def _error(calibration: Calibration, error: ExpectedError) -> dict[str, Any]:
    return {
        "own": error.own,
        "other": error.other,
        "distance_mm": depths_mm(calibration)[1],
        "form_rms_mm": _number(map_rms(error.form_mm)),
        "scale_rms_mm": _number(map_rms(error.scale_mm)),
        "sensor_rms_mm": _number(map_rms(error.sensor_mm)),
        "scale_sigma": error.scale_sigma,
    }


def _views(calibration: Calibration) -> list[dict[str, Any]]:
    images = {view.name: dict(view.images) for view in calibration.observations.views}
    return [
        {
            "name": place.view,
            "images": images.get(place.view, {}),
            "T_A_board": np.asarray(calibration.T_A_board[place.view]).tolist(),
            "distance_mm": place.distance_mm,
            "tilt_rad": place.tilt_rad,
            "residuals": [
                {
                    "device": r.device,
                    "through": r.through,
                    "points": int((~r.outlier).sum()),
                    "rms_px": _number(r.rms_px),
                    "outliers": [int(index) for index in r.index[r.outlier]],
                }
                for r in calibration.residuals
                if r.view == place.view
            ],
        }
        for place in placements(calibration)
    ]
