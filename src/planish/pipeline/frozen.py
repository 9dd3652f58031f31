"""What a run of files fixes for all that is added to it later: `stages/frozen.json`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field

from planish import storage
from planish.errors import InputError
from planish.files.given import GivenFiles
from planish.options import Strict
from planish.pipeline.options import RegisterOptions
from planish.pipeline.stages import Source

SCHEMA = "planish.frozen/1"


class FrozenMeasurement(Strict):
    """A measurement of a run, as it was when it was registered."""

    name: str
    path: str
    sha256: str
    size_bytes: int
    mtime_ns: int
    gsd_mm: float | None
    sensor: str | None
    centroid_sensor: tuple[float, float, float]

    @classmethod
    def of(cls, source: Source) -> Self:
        """Return what is kept of a measurement file."""
        x, y, z = source.centroid_sensor.tolist()
        return cls(
            name=source.name, path=str(source.path), sha256=source.sha256, size_bytes=source.size_bytes,
            mtime_ns=source.mtime_ns, gsd_mm=source.gsd_mm if np.isfinite(source.gsd_mm) else None,
            sensor=source.sensor, centroid_sensor=(x, y, z),
        )  # fmt: skip

    def source(self) -> Source | None:
        """Return the file as it was, where size and time of the last change say that it is so still; else None."""
        path = Path(self.path)
        found = path.stat()
        if (found.st_size, found.st_mtime_ns) != (self.size_bytes, self.mtime_ns):
            return None
        gsd = float("nan") if self.gsd_mm is None else self.gsd_mm
        return Source(
            self.name, path, self.sha256, self.size_bytes, self.mtime_ns, gsd, self.sensor,
            np.array(self.centroid_sensor),
        )  # fmt: skip


class Batch(Strict):
    """Measurements that came together, and the pairs that were tried because of them."""

    measurements: tuple[FrozenMeasurement, ...]
    pairs: tuple[tuple[str, str], ...]


class _FrozenFile(Strict):
    schema_: Literal["planish.frozen/1"] = Field(alias="schema")
    gsd_mm: float = Field(gt=0)
    options: dict[str, Any]
    reference: str | None
    given: dict[Literal["known_points", "prior", "fixed"], str]
    batches: tuple[Batch, ...] = Field(min_length=1)


@dataclass(frozen=True)
class Frozen:
    """The run's resolution [mm per pixel], its options and further files as the user gave them, and its batches,
    the first run first.

    The pattern of a sensor is that of all batches up to the measurement's own: what was computed stays valid.
    """

    gsd_mm: float
    options: RegisterOptions
    reference: str | None
    given: GivenFiles
    batches: tuple[Batch, ...]

    def save(self, folder: Path) -> None:
        """Write the file into the folder of the stages."""
        storage.write_json(
            folder / "frozen.json",
            {
                "schema": SCHEMA,
                "gsd_mm": self.gsd_mm,
                "options": self.options.model_dump(mode="json", exclude_unset=True),
                "reference": self.reference,
                "given": {name: str(path.resolve()) for name, path in self.given.named().items()},
                "batches": [batch.model_dump(mode="json") for batch in self.batches],
            },
        )

    @classmethod
    def load(cls, folder: Path) -> Frozen:
        """Read the file from the folder of the stages.

        Raises
        ------
        InputError
            Where there is none: nothing has been registered there, or not to the end.
        """
        path = folder / "frozen.json"
        if not path.is_file():
            raise InputError(folder.parent, "holds no finished registration of files", "a folder of `planish register`")
        content = _FrozenFile.parse(storage.read_json(path), str(path))
        options = RegisterOptions.parse(content.options, f"{path}: options")
        given = GivenFiles(**{name: Path(file) for name, file in content.given.items()})
        return cls(content.gsd_mm, options, content.reference, given, content.batches)
