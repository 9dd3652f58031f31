"""MAT-files of all versions as plain values: structs as dicts, arrays in the shape that MATLAB shows, text as str."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError

#: `MATLAB_object_decode` of objects in files of version 7.3: of the old class system, and of today's.
_OBJECTS = (2, 3)


@dataclass(frozen=True)
class MatlabObject:
    """An object of a MATLAB class: what is inside, only MATLAB knows to read."""

    class_name: str


@dataclass(frozen=True)
class Unread:
    """A value that no calibration is made of: a cell array, a struct array, a function handle."""


Value: TypeAlias = "dict[str, Value] | NDArray[Any] | str | MatlabObject | Unread"


def read_mat_file(path: Path) -> dict[str, Value]:
    """Return the variables of a MAT-file, version 4 to 7 (SciPy) or 7.3 (HDF5).

    Raises
    ------
    InputError
        Where the file is missing, damaged or no MAT-file.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "no such file", "a MAT-file")
    try:
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                return {name: _from_hdf5(file[name]) for name in file if not name.startswith("#")}
        return _read_scipy(path)
    # What a damaged file makes SciPy and HDF5 raise has no common base.
    except Exception as error:
        raise InputError(path, f"is damaged or no MAT-file ({error})", "a file that MATLAB saved") from None


def _read_scipy(path: Path) -> dict[str, Value]:
    # Here, not above: it takes a third of a second to be imported.
    from scipy.io import loadmat, matlab

    def convert(value: Any) -> Value:
        if isinstance(value, matlab.MatlabOpaque):
            return MatlabObject(opaque_name(value, "s2", "_Class"))
        if isinstance(value, matlab.MatlabObject):
            return MatlabObject(str(value.classname))
        if not isinstance(value, np.ndarray) or isinstance(value, matlab.MatlabFunction) or value.dtype.kind == "O":
            return Unread()
        if value.dtype.names is not None:
            if value.size != 1:
                return Unread()
            item = value.ravel()[0]
            return {name: convert(item[name]) for name in value.dtype.names}
        return "".join(map(str, value.ravel())) if value.dtype.kind in "US" else value

    def opaque_name(value: Any, *fields: str) -> str:
        for field in fields:
            if field in (value.dtype.names or ()):
                name = value.ravel()[0][field]
                return name.decode() if isinstance(name, bytes) else str(name)
        return "unknown"

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content = loadmat(path, chars_as_strings=True, struct_as_record=True, squeeze_me=False)
    variables: dict[str, Value] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            # SciPy files the objects of classes under "None"; their own name stands inside.
            opaque = isinstance(value, matlab.MatlabOpaque)
            variables[opaque_name(value, "s0") if opaque and name == "None" else name] = convert(value)
    return variables


def _from_hdf5(node: Any) -> Value:
    name = node.attrs.get("MATLAB_class", b"")
    kind = name.decode() if isinstance(name, bytes) else str(name)
    decode = int(node.attrs.get("MATLAB_object_decode", 0))
    if decode in _OBJECTS:
        return MatlabObject(kind)
    if decode or kind in ("cell", "function_handle"):
        return Unread()
    if isinstance(node, h5py.Group):
        # Of a struct array, each field is a dataset of references without a class of its own.
        fields = {key: node[key] for key in node}
        if any("MATLAB_class" not in child.attrs for child in fields.values()):
            return Unread()
        return {key: _from_hdf5(child) for key, child in fields.items()}
    if node.attrs.get("MATLAB_empty", 0):
        # An empty array's dataset holds its shape.
        return "" if kind == "char" else {} if kind == "struct" else np.zeros(tuple(int(n) for n in node[()]))
    if kind == "char":
        return "".join(map(chr, node[()].T.ravel()))
    # MATLAB stores columns first; HDF5 names the dimensions the other way round.
    return np.asarray(node[()]).T
