"""Errors against truth and their file `evaluation.json` (schema planish.evaluation/1)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from planish import storage

SCHEMA = "planish.evaluation/1"


@dataclass(frozen=True)
class PairError:
    """Error of one accepted pair: e = (T_hat - T_true) x over the true overlap; None where truth does not tell.

    `overlap` is the true one where truth is known, else the estimated one. `nees` has 6 degrees of freedom.
    """

    a: str
    b: str
    overlap: float | None
    rotation_error_rad: float | None = None
    tangential_rms_mm: float | None = None
    normal_rms_mm: float | None = None
    nees: float | None = None


@dataclass(frozen=True)
class MeasurementError:
    """Error of one measurement's place in the world of its group, over its own points.

    `nees` is None for the reference, whose place is exact by definition.
    """

    name: str
    tangential_rms_mm: float | None = None
    normal_rms_mm: float | None = None
    nees: float | None = None


@dataclass(frozen=True)
class Evaluation:
    """Errors of a registration; `findings` says in plain words what is wrong or missing (not in the JSON)."""

    pairs: tuple[PairError, ...]
    measurements: tuple[MeasurementError, ...]
    findings: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the content of `evaluation.json`."""
        return {
            "schema": SCHEMA,
            "pairs": [asdict(pair) for pair in self.pairs],
            "measurements": [asdict(measurement) for measurement in self.measurements],
        }

    def save(self, path: Path) -> None:
        """Write `evaluation.json`."""
        storage.write_json(Path(path), self.to_json())
