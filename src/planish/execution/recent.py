"""What a process has made lately and may need again: bounded by number and by memory, the oldest goes first."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from itertools import islice
from typing import Any, TypeVar

import numpy as np

Value = TypeVar("Value")

#: Most objects that are kept.
MAX_NUMBER = 64
#: Memory that a worker's objects may take. With what a pair needs while it is computed, a worker stays at 1.5 GB.
WORKER_BYTES = 2**30


class Recent:
    """Objects by key; `get` makes what is not there, once, whatever number of threads ask for it."""

    def __init__(self, max_bytes: int, max_number: int = MAX_NUMBER) -> None:
        self.max_bytes, self.max_number = max_bytes, max_number
        self._items: OrderedDict[Hashable, Any] = OrderedDict()
        #: Per object its arrays and their memory, as of when it was last looked at.
        self._arrays: dict[Hashable, dict[int, int]] = {}
        #: By how many objects each array is held, and the memory of all of them.
        self._holders: dict[tuple[int, int], int] = {}
        self._bytes = 0
        self._making: dict[Hashable, threading.Lock] = {}
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the object of `key`, made by `make` where it is not there."""
        with self._lock:
            turn = self._making.setdefault(key, threading.Lock())
        with turn:
            with self._lock:
                found = key in self._items
                if found:
                    self._items.move_to_end(key)
                    value: Value = self._items[key]
            if not found:
                value = make()
            with self._lock:
                self._items[key] = value
                self._making.pop(key, None)
                self._drop()
        return value

    def used(self) -> list[Hashable]:
        """Return the keys of all objects, those used last at the end."""
        with self._lock:
            return list(self._items)

    def peek(self, key: Hashable) -> Any:
        """Return the object of `key`, or None."""
        with self._lock:
            return self._items.get(key)

    def forget(self, key: Hashable) -> None:
        """Drop an object: another one has taken it over."""
        with self._lock:
            self._items.pop(key, None)
            self._look(key)

    def clear(self) -> None:
        """Drop all objects."""
        with self._lock:
            self._items.clear()
            for key in list(self._arrays):
                self._look(key)

    def _drop(self) -> None:
        # Objects grow while they are in use: some of their parts are made on demand. Others stay as they are, and to
        # look at all of them each time would take longer than what they are kept for.
        for key in islice(reversed(self._items), _IN_USE):
            self._look(key)
        while len(self._items) > 1 and (len(self._items) > self.max_number or self._bytes > self.max_bytes):
            key, _ = self._items.popitem(last=False)
            self._look(key)

    def _look(self, key: Hashable) -> None:
        """Count the arrays of an object anew; none where it is no longer there."""
        before = self._arrays.pop(key, {})
        now = arrays_of(self._items[key]) if key in self._items else {}
        if now:
            self._arrays[key] = now
        for array in now.items() - before.items():
            self._holders[array] = self._holders.get(array, 0) + 1
            self._bytes += array[1] if self._holders[array] == 1 else 0
        for array in before.items() - now.items():
            self._holders[array] -= 1
            if not self._holders[array]:
                del self._holders[array]
                self._bytes -= array[1]


#: So many objects, those asked for last, may be in use: two by each of some threads.
_IN_USE = 8


def arrays_of(value: Any) -> dict[int, int]:
    """Return the memory [bytes] of all arrays that objects, mappings and sequences hold, by the array's identity."""
    seen: dict[int, int] = {}
    _collect(value, seen)
    return seen


def _collect(value: Any, seen: dict[int, int]) -> None:
    if type(value) in _WITHOUT_ARRAYS:
        return
    if isinstance(value, np.ndarray):
        base = value
        while isinstance(base.base, np.ndarray):
            base = base.base
        seen[id(base)] = base.nbytes
    elif isinstance(value, tuple | list):
        for item in value:
            _collect(item, seen)
    elif isinstance(value, Mapping):
        for item in list(value.values()):
            _collect(item, seen)
    elif hasattr(value, "__dict__"):
        # What properties have computed stands there, too.
        for item in list(vars(value).values()):
            _collect(item, seen)


#: Asked first: most of what objects consist of is one of these.
_WITHOUT_ARRAYS = frozenset({type(None), str, bytes, bool, int, float})


def main_process_bytes() -> int:
    """Return the memory that objects may take in the process that the user has started: a quarter of the machine's."""
    try:
        return max(WORKER_BYTES, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4)
    except (AttributeError, ValueError, OSError):
        return WORKER_BYTES


#: The objects of this process.
RECENT = Recent(WORKER_BYTES)
