"""One mechanism to save and load the frozen dataclasses that pass between stages: one HDF5 file each.

Arrays become datasets, other values attributes, nested objects groups, units attributes. A file is written under a
temporary name and renamed when whole, so an interrupted run never leaves half a file under a valid name. It is mapped
or read into memory as a whole, and the arrays that come from it lie there, not to be written to.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import mmap
import os
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError

T = TypeVar("T")

#: Bytes of a file.
Content = NDArray[np.uint8]

#: Files of so many bytes are mapped: measurements are, not the many small ones, of which each would stay open.
_MAPPED_BYTES = 16 * 2**20
#: Marks a field that holds None (HDF5 has no such value).
_NONE = "planish: none"
#: Arrays of at least so many bytes begin at multiples of the other number, so that they can be used where they lie.
_ALIGNMENT = {"alignment_threshold": 1024, "alignment_interval": 64}


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` when the block ends well, remove it otherwise."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(path.parent, f"cannot be made a folder ({error.strerror})", "a folder to write to") from None
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON (two spaces, no NaN) under a temporary name, then rename."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; an error names the file."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "a JSON file") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(path, f"is not valid JSON ({error})", "a JSON file") from None
    if not isinstance(content, dict):
        raise InputError(path, f"holds a JSON {type(content).__name__}", "a JSON object")
    return content


def content_of(file: IO[bytes]) -> Content:
    """Return what an open file holds from its beginning, whatever has been read of it."""
    size = file.seek(0, io.SEEK_END)
    if size >= _MAPPED_BYTES:
        # Where a file cannot be mapped, as on some network drives, it is read.
        with contextlib.suppress(OSError, ValueError):
            return _mapped(file)
    file.seek(0)
    content = np.empty(size, np.uint8)
    # A file may end sooner than it said, where something else is writing it.
    content = content[: file.readinto(content)]  # type: ignore[attr-defined]
    content.flags.writeable = False
    return content


def _mapped(file: IO[bytes]) -> Content:
    """Return the file itself as memory: no copy, and the system may take back what is not in use."""
    content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    if hasattr(mmap, "MADV_WILLNEED"):
        # The whole file is asked for at once, not page by page as it is looked at.
        content.madvise(mmap.MADV_WILLNEED)
    return np.frombuffer(content, np.uint8)


def read_content(path: Path, schema: str) -> Content:
    """Return what a file that should be of a schema holds; an error names the file."""
    if not path.is_file():
        raise InputError(path, "no such file", f"a file of schema {schema}")
    try:
        with path.open("rb") as file:
            return content_of(file)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", f"a file of schema {schema}") from None


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def create(path: Path, userblock_size: int = 0) -> Any:
    """Return a new HDF5 file, open to be written; its first bytes are left to the user."""
    return h5py.File(path, "w", track_order=True, userblock_size=userblock_size, **_ALIGNMENT)


def opened(content: Content) -> Any:
    """Return the HDF5 file that lies in memory, open to be read."""
    return h5py.File(_Memory(content), "r")


def save(path: Path, value: Any, schema: str) -> None:
    """Write a dataclass to an HDF5 file whose `schema` attribute is `schema`."""
    with replacing(Path(path)) as temporary, create(temporary) as file:
        file.attrs["schema"] = schema
        write_fields(file, value)


def load(path: Path, kind: type[T], schema: str) -> T:
    """Return the object of dataclass `kind` from an HDF5 file.

    Raises
    ------
    InputError
        Where the file is missing, damaged, no HDF5 file or of another schema.
    """
    return load_content(read_content(Path(path), schema), Path(path), kind, schema)


def load_content(content: Content, path: Path, kind: type[T], schema: str) -> T:
    """Return what `load` does, of a file that has been read; its arrays lie in `content`."""
    try:
        with opened(content) as file:
            found = file.attrs.get("schema")
            if found != schema:
                raise InputError(path, f"schema is {found!r}", f"'{schema}'")
            return read_fields(file, content, kind)
    except InputError as error:
        if error.subject.startswith(str(path)):
            raise
        raise InputError(f"{path}: {error.subject}", error.found, error.expected) from None
    except (OSError, LookupError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise InputError(path, f"is damaged or not HDF5 ({error})", f"a whole file of schema {schema}") from None


class _Memory(io.RawIOBase):
    """A file in memory: bytes that are read where they lie."""

    def __init__(self, content: Content) -> None:
        self._content, self._at = content.data, 0

    def seekable(self) -> bool:
        """Return True."""
        return True

    def readable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place, and return it."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: len(self._content)}[whence]
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        """Return the place."""
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the place on; return with how many bytes."""
        found = self._content[self._at : self._at + len(buffer)]
        buffer[: len(found)] = found
        self._at += len(found)
        return len(found)


def write_fields(group: Any, value: Any) -> None:
    """Write the fields of a dataclass into an HDF5 group."""
    for field in dataclasses.fields(value):
        _write(group, field.name, getattr(value, field.name), field.metadata.get("unit"))


def _write(group: Any, name: str, item: Any, unit: str | None = None) -> None:
    if item is None:
        group.attrs[name] = _NONE
    elif hasattr(item, "to_json"):
        group.attrs[name] = json.dumps(item.to_json())
    elif dataclasses.is_dataclass(item):
        write_fields(group.create_group(name, track_order=True), item)
    elif isinstance(item, Mapping):
        child = group.create_group(name, track_order=True)
        for key, entry in item.items():
            _write(child, str(key), entry, unit)
    elif isinstance(item, np.ndarray):
        dataset = group.create_dataset(name, data=item)
        if unit:
            dataset.attrs["unit"] = unit
    elif isinstance(item, tuple) and item and dataclasses.is_dataclass(item[0]):
        _write(group, name, {f"{i:03d}": entry for i, entry in enumerate(item)}, unit)
    elif isinstance(item, tuple):
        group.attrs[name] = json.dumps(list(item))
    else:
        group.attrs[name] = item


def read_fields(group: Any, content: Content, kind: type[T]) -> T:
    """Return the object of dataclass `kind` whose fields an HDF5 group holds; its file lies in `content`."""
    return kind(**{name: _read(group, content, name, hint) for name, hint in _hints(typing.cast(Any, kind))})


@functools.cache
def _hints(kind: type[Any]) -> tuple[tuple[str, Any], ...]:
    """Return the names and types of the fields of a dataclass: to find them takes longer than to read small ones."""
    hints = typing.get_type_hints(kind)
    return tuple((field.name, hints[field.name]) for field in dataclasses.fields(kind))


def _read(group: Any, content: Content, name: str, hint: Any) -> Any:
    if name in group.attrs:
        item = group.attrs[name]
        if isinstance(item, str) and item == _NONE:
            return None
        hint = _without_none(hint)
        if hasattr(hint, "from_json"):
            return hint.from_json(json.loads(item))
        if typing.get_origin(hint) is tuple:
            return tuple(json.loads(item))
        return item.item() if isinstance(item, np.generic) else item
    if name not in group:
        raise InputError(
            f"{group.name.strip('/')}/{name}".strip("/"), "is missing", "a file of this version of planish"
        )
    node, hint = group[name], _without_none(hint)
    origin = typing.get_origin(hint)
    if origin in (dict, Mapping) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        return {
            key: _read(node, content, key, typing.get_args(hint)[1]) for key in [*node.keys(), *_own_attributes(node)]
        }
    if origin is tuple:
        return tuple(_read(node, content, key, typing.get_args(hint)[0]) for key in sorted(node.keys()))
    if dataclasses.is_dataclass(hint):
        return read_fields(node, content, typing.cast(Any, hint))
    return _array(node, content)


def _array(dataset: Any, content: Content) -> Any:
    """Return the values of a dataset: where they lie, if they lie there as they are used, else a copy."""
    kind, offset = dataset.dtype, dataset.id.get_offset()
    # No offset: values in chunks or none at all.
    if offset is None or not kind.isnative or kind.hasobject or offset % kind.alignment:
        return dataset[()]
    return content[offset : offset + dataset.nbytes].view(kind).reshape(dataset.shape)


def _own_attributes(node: Any) -> list[str]:
    return [key for key in node.attrs if key != "schema"]


def _without_none(hint: Any) -> Any:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = [part for part in typing.get_args(hint) if part is not type(None)]
    return hint
