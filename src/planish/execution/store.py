"""Results of stages, kept in files by what they were computed from: an interrupted run goes on where it was.

A result's key is a hash of all that it depends on: content of the inputs, options that the stage reads, and the code.
So a file that is there is right, whoever wrote it and when; what has changed has another key. Each file carries its own
hash in the 512 bytes before its HDF5 part, which HDF5 leaves to the user: a damaged one is computed again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import scipy

from planish import _core, storage
from planish.errors import InputError

T = TypeVar("T")

SCHEMA = "planish.stage/1"
#: Bytes before the HDF5 part (the smallest user block of HDF5), and what they begin with.
_BLOCK_BYTES, _MARK = 512, b"planish.stage/1 sha256 "
#: Parts of the package that no stage depends on.
_NOT_IN_STAGES = ("cli", "execution", "files", "report", "simulation")


@dataclass(frozen=True)
class StageStore:
    """The folder of the stage files: one per stage and key."""

    folder: Path

    def path(self, stage: str, key: str) -> Path:
        """Return the file of a result."""
        return self.folder / stage / f"{key[:32]}.h5"

    def read(self, stage: str, key: str, kind: type[T]) -> T | None:
        """Return a result of dataclass `kind`; None where it is not there, or not whole."""
        try:
            with self.path(stage, key).open("rb") as file:
                content = storage.content_of(file)
        except OSError:
            return None
        if content[:_BLOCK_BYTES].tobytes() != _seal(content):
            return None
        return self._read(content, stage, key, kind)

    def _read(self, content: storage.Content, stage: str, key: str, kind: type[T]) -> T | None:
        try:
            with storage.opened(content) as file:
                if (file.attrs["schema"], file.attrs["stage"], file.attrs["key"]) != (SCHEMA, stage, key):
                    return None
                return storage.read_fields(file, content, kind)
        except (InputError, OSError, LookupError, RuntimeError, TypeError, ValueError, AttributeError):
            return None

    def write(self, stage: str, key: str, value: Any) -> storage.Content:
        """Write a result under a temporary name, seal it, and rename it; return what the file then holds."""
        with storage.replacing(self.path(stage, key)) as temporary:
            with storage.create(temporary, _BLOCK_BYTES) as file:
                file.attrs["schema"], file.attrs["stage"], file.attrs["key"] = SCHEMA, stage, key
                storage.write_fields(file, value)
            with temporary.open("r+b") as plain:
                content = storage.content_of(plain)
                plain.seek(0)
                plain.write(_seal(content))
        return content

    def read_or_make(self, stage: str, key: str, kind: type[T], make: Callable[[], T]) -> tuple[T, bool]:
        """Return a result, and whether it was there; what `make` returns is written and read back.

        Read back: so that the bits do not depend on who made it.
        """
        found = self.read(stage, key, kind)
        if found is not None:
            return found, True
        found = self._read(self.write(stage, key, make()), stage, key, kind)
        if found is None:
            raise InputError(self.path(stage, key), "cannot be read back", "a disk that keeps what is written to it")
        return found, False

    def remove_unfinished(self) -> None:
        """Remove what killed processes have left of files they were writing."""
        for path in self.folder.glob("*/.*.part"):
            path.unlink(missing_ok=True)


def _seal(content: storage.Content) -> bytes:
    """Return the block before the HDF5 part of a file that holds `content` after it."""
    digest = hashlib.sha256(content[_BLOCK_BYTES:].data).hexdigest()
    return (_MARK + digest.encode() + b"\n").ljust(_BLOCK_BYTES, b"\0")


def content_key(stage: str, *parts: Any) -> str:
    """Return the key of a result: a hash of the stage, the code, and all parts (plain JSON values)."""
    text = json.dumps([stage, code_version(), *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def code_version() -> str:
    """Return a hash of everything that results depend on besides data and options: planish's code, its libraries."""
    package = Path(storage.__file__).parent
    modules = (path.relative_to(package) for path in package.rglob("*.py"))
    digest = hashlib.sha256()
    for module in sorted(path.as_posix() for path in modules if path.parts[0] not in _NOT_IN_STAGES):
        digest.update(module.encode() + b"\0" + (package / module).read_bytes())
    chosen = "planish._core_avx2" if _core.cpu_has_avx2() else "planish._core_baseline"
    digest.update(Path(str(import_module(chosen).__file__)).read_bytes())
    digest.update(f"{np.__version__} {scipy.__version__} {cv2.__version__}".encode())
    return digest.hexdigest()
