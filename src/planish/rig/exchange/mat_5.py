"""MAT-files of version 5 (MATLAB 5 to 7.2, and today's default): MathWorks, "MAT-File Format".

SciPy's reader is not used: a damaged file can crash it with the whole process (seen with SciPy 1.17), and importing it
takes a third of a second. Class objects, which the document leaves out, are as MATLAB R2019a writes them: array flags,
three texts (variable, type system, class), and a matrix with a reference (https://stackoverflow.com/q/66040231).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from planish.rig.exchange.mat_values import MatlabObject, Unread, Value

#: Text, place of the content of objects, version, byte order.
HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
#: Storage of numbers: NumPy's type by data type.
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
#: Storage of text: encoding by data type; UTF-16 and 32 in the byte order of the file.
_TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
#: Classes of arrays.
_CELL, _STRUCT, _OLD_OBJECT, _CHAR, _FIRST_NUMBER, _LAST_NUMBER, _OPAQUE = 1, 2, 3, 4, 6, 15, 17
_IS_COMPLEX = 0x800


def read_mat_5(data: bytes) -> dict[str, Value]:
    """Return the variables in the bytes of a file.

    Raises
    ------
    ValueError, LookupError, zlib.error
        Where the bytes are damaged.
    """
    orders = {b"IM": "<", b"MI": ">"}
    if data[HEADER - 2 : HEADER] not in orders:
        raise ValueError("no mark of the byte order")
    order = orders[data[HEADER - 2 : HEADER]]
    variables = {}
    for kind, content in _elements(data[HEADER:], order):
        if kind == _COMPRESSED:
            ((kind, content),) = _elements(zlib.decompress(content), order)
        if kind == _MATRIX:
            name, value = _matrix(content, order)
            # A variable without a name is the content of objects.
            if name:
                variables[name] = value
    return variables


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Data type and bytes of each element."""
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError("ends within an element")
        kind, size = (int(number) for number in np.frombuffer(data, f"{order}u4", 2, at))
        if kind >> 16:  # size and type in one word, up to 4 bytes in the other
            kind, size, begin, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        else:
            begin, step = at + 8, 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if begin + size > len(data) or (begin == at + 4 and size > 4):
            raise ValueError("ends within an element")
        yield kind, data[begin : begin + size]
        at += step


def _matrix(data: bytes, order: str) -> tuple[str, Value]:
    """Name and value of an array."""
    if not data:
        return "", np.empty((0, 0))
    parts = _elements(data, order)
    flags = int(_numbers(*next(parts), order)[0])
    array_class = flags & 0xFF
    if array_class == _OPAQUE:
        name, _, class_name = (_text(*next(parts), order) for _ in range(3))
        return name, MatlabObject(class_name)
    shape = tuple(int(n) for n in _numbers(*next(parts), order))
    name = _text(*next(parts), order)
    if array_class == _OLD_OBJECT:
        return name, MatlabObject(_text(*next(parts), order))
    if array_class == _STRUCT:
        return name, _struct(parts, shape, order)
    if array_class == _CHAR:
        return name, _text(*next(parts), order)
    if not _FIRST_NUMBER <= array_class <= _LAST_NUMBER or flags & _IS_COMPLEX:
        return name, Unread()
    return name, _numbers(*next(parts), order).reshape(shape, order="F")


def _struct(parts: Iterator[tuple[int, bytes]], shape: tuple[int, ...], order: str) -> Value:
    length = int(_numbers(*next(parts), order)[0])
    _, names = next(parts)
    if math.prod(shape) != 1 or length < 1:
        return Unread()
    fields = {}
    for start in range(0, len(names), length):
        kind, content = next(parts)
        if kind != _MATRIX:
            raise ValueError("a field that is no array")
        fields[names[start : start + length].split(b"\0")[0].decode("latin-1")] = _matrix(content, order)[1]
    return fields


def _numbers(kind: int, data: bytes, order: str) -> NDArray[np.number]:
    return np.frombuffer(data, order + _NUMBERS[kind])


def _text(kind: int, data: bytes, order: str) -> str:
    encoding = _TEXT[kind]
    return data.decode(encoding + ("-le" if order == "<" else "-be") if encoding in ("utf-16", "utf-32") else encoding)
