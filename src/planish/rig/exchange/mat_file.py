"""MAT-files of version 5 to 7.3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from planish.errors import InputError
from planish.rig.exchange.mat_5 import read_mat_5
from planish.rig.exchange.mat_values import MatlabObject, Unread, Value

#: `MATLAB_object_decode` of objects in files of version 7.3: of the old class system, and of today's.
_OBJECTS = (2, 3)


def read_mat_file(path: Path) -> dict[str, Value]:
    """Return the variables of a MAT-file.

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
        return read_mat_5(path.read_bytes())
    # What damaged bytes make HDF5, zlib and NumPy raise has no common base.
    except Exception as error:
        raise InputError(path, f"is damaged or no MAT-file ({error})", "a file that MATLAB saved") from None


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
        return "" if kind == "char" else {} if kind == "struct" else np.empty((0, 0))
    if kind == "char":
        return "".join(map(chr, node[()].T.ravel()))
    # MATLAB stores columns first; HDF5 names the dimensions the other way round. Complex numbers are pairs.
    return Unread() if node.dtype.names else np.asarray(node[()]).T
