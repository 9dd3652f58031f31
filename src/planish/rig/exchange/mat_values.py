"""What is in a MAT-file, as plain values: structs as dicts, arrays in the shape that MATLAB shows, text as str."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

from numpy.typing import NDArray


@dataclass(frozen=True)
class MatlabObject:
    """An object of a MATLAB class: what is inside, only MATLAB knows to read."""

    class_name: str


@dataclass(frozen=True)
class Unread:
    """A value that no calibration is made of: a cell array, a struct array, a function handle, complex numbers."""


Value: TypeAlias = "dict[str, Value] | NDArray[Any] | str | MatlabObject | Unread"
