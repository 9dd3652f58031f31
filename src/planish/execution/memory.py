"""Memory that has been freed: kept for the next arrays while work goes on, then given back to the system."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from planish import _core


@contextmanager
def kept_memory() -> Iterator[None]:
    """Keep what is freed for the next arrays while the block runs; blocks may lie in one another and overlap."""
    _KEPT.enter()
    try:
        yield
    finally:
        _KEPT.leave()


class _Kept:
    """What this process keeps: from the first block's begin to the last one's end."""

    def __init__(self) -> None:
        self._lock, self._inside, self._huge_pages = threading.Lock(), 0, True

    def enter(self) -> None:
        with self._lock:
            if self._inside == 0:
                _core.keep_memory(True)
                self._huge_pages = _core.allow_huge_pages(False)
            self._inside += 1

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                _core.allow_huge_pages(self._huge_pages)
                _core.keep_memory(False)


_KEPT = _Kept()
