"""Threads of libraries: planish shares out the processors itself.

Its matrices are small or narrow, and several of its threads multiply at a time. A BLAS with threads of its own makes
these wait for each other, and spends the processors on waiting: the longer the busier the machine is. With one thread,
the bits do not depend on the number of processors either.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@contextmanager
def serial_linear_algebra() -> Iterator[None]:
    """Let BLAS and LAPACK use one thread in this process while the block runs; blocks may overlap in threads."""
    _LIMIT.enter()
    try:
        yield
    finally:
        _LIMIT.leave()


class _Limit:
    """The limit of this process: the first block sets it, the last one to end takes it back."""

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, ExitStack()
        # threadpoolctl lets only the thread that has set a limit take it back.
        self._setter = ThreadPoolExecutor(1)

    def enter(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._setter.submit(self._set).result()
            self._inside += 1

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._setter.submit(self._before.close).result()

    def _set(self) -> None:
        self._before.enter_context(_libraries().limit(limits=1, user_api="blas"))


_LIMIT = _Limit()


@cache
def _libraries() -> ThreadpoolController:
    # Once, for it takes a while; when it is first asked for, all that is used here has been imported.
    return ThreadpoolController()
