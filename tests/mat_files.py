"""MAT-files laid out as MATLAB writes them, byte by byte where SciPy cannot: class objects, version 7.3."""

from __future__ import annotations

import struct

import h5py
import numpy as np
from scipy.io import savemat

#: What stands in place of an object's content: a magic number, the shape, its number and that of its class.
OBJECT_REFERENCE = np.array([0xDD000000, 2, 1, 1, 1, 1], np.uint32)
MI_INT8, MI_INT32, MI_UINT32, MI_MATRIX = 1, 5, 6, 14
MX_UINT32, MX_OPAQUE = 13, 17


def write_v5(path, **variables):
    """Versions 6 and 7."""
    savemat(path, {name: _for_scipy(value) for name, value in variables.items()}, oned_as="row")
    return path


def _for_scipy(value):
    if isinstance(value, dict):
        return {name: _for_scipy(item) for name, item in value.items()}
    return value if isinstance(value, str) else np.atleast_2d(value)


def write_v73(path, **variables):
    """Version 7.3: HDF5 behind a block of 512 bytes, columns first, each item with its class."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            _put(file, name, value)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Tue Feb  2 12:32:06 2021 HDF5 schema 1.00 .")
    return path


def _put(group, name, value):
    if isinstance(value, dict):
        node, kind = group.create_group(name), "struct"
        for key, item in value.items():
            _put(node, key, item)
    elif isinstance(value, str):
        codes = np.array([[ord(letter)] for letter in value], np.uint16).reshape(-1, 1)
        node, kind = group.create_dataset(name, data=codes), "char"
        node.attrs["MATLAB_int_decode"] = np.int32(2)
    else:
        array = np.atleast_2d(value)
        kind = "logical" if array.dtype == bool else "double"
        # An empty array's dataset holds its shape.
        data = array.T if array.size else np.array(array.shape, np.uint64)
        node = group.create_dataset(name, data=data.astype(np.uint8) if kind == "logical" else data)
        if kind == "logical":
            node.attrs["MATLAB_int_decode"] = np.int32(1)
        if not array.size:
            node.attrs["MATLAB_empty"] = np.uint8(1)
    node.attrs["MATLAB_class"] = np.bytes_(kind)


def write_v5_object(path, name, class_name):
    """An object saved as it is, version 7: an opaque array, its content in a nameless variable at the end.

    SciPy reads it as it reads such a file by MATLAB R2019a, printed in https://stackoverflow.com/q/66040231: under the
    name "None", (name, "MCOS", class, the six numbers of OBJECT_REFERENCE), and as "__function_workspace__".
    """
    flags = _element(MI_UINT32, struct.pack("<II", MX_OPAQUE, 0))
    strings = b"".join(_element(MI_INT8, text.encode()) for text in (name, "MCOS", class_name))
    opaque = _element(MI_MATRIX, flags + strings + _matrix("", MX_UINT32, OBJECT_REFERENCE[:, None], MI_UINT32))
    workspace = _matrix("", 9, np.zeros((1, 16), np.uint8), 2)
    head = b"MATLAB 5.0 MAT-file, Platform: PCWIN64, Created on: Tue Feb  2 12:32:06 2021".ljust(116)
    # The place of the nameless variable, version 1.0, "IM": little-endian.
    head += struct.pack("<Q", 128 + len(opaque)) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + opaque + workspace)
    return path


def _matrix(name, mx_class, array, mi_type):
    flags = _element(MI_UINT32, struct.pack("<II", mx_class, 0))
    shape = _element(MI_INT32, struct.pack("<ii", *array.shape))
    return _element(MI_MATRIX, flags + shape + _element(MI_INT8, name.encode()) + _element(mi_type, array.tobytes("F")))


def _element(mi_type, data):
    return struct.pack("<II", mi_type, len(data)) + data + b"\0" * (-len(data) % 8)


def write_v73_object(path, name, class_name):
    """An object saved as it is, version 7.3: a dataset (1, 6), its content under #subsystem# (mat7.3, pull 70)."""
    with h5py.File(path, "w", userblock_size=512) as file:
        node = file.create_dataset(name, data=OBJECT_REFERENCE[None])
        node.attrs["MATLAB_class"] = np.bytes_(class_name)
        node.attrs["MATLAB_object_decode"] = np.int32(3)
        wrapper = file.create_dataset("#subsystem#/MCOS", (1, 1), h5py.ref_dtype)
        wrapper.attrs["MATLAB_class"] = np.bytes_("FileWrapper__")
        wrapper.attrs["MATLAB_object_decode"] = np.int32(3)
    return path
