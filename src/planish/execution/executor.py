"""What runs a stage: the protocol of all executors, and the one that uses threads of this process.

A stage is a function at the top of a module, called with an item and a number of threads: pure, so that it does not
matter which process calls it, when, or how often. Items and values pass between processes and stay small: file names,
options, keys. What is large lies in files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from types import TracebackType
from typing import Protocol, Self, TypeVar

import cv2

from planish.execution.memory import kept_memory
from planish.execution.recent import RECENT, WORKER_BYTES, main_process_bytes
from planish.options import thread_count

Item = TypeVar("Item")
Value = TypeVar("Value")


class Executor(Protocol):
    """Runs a function over items; use it in a `with` statement, which ends what it has started."""

    @property
    def slots(self) -> int:
        """How many items are worked on at a time."""

    @property
    def shares_memory(self) -> bool:
        """Whether all items find in memory what earlier ones have left there."""

    def map(self, function: Callable[[Item, int], Value], items: Sequence[Item]) -> Iterator[tuple[int, Value]]:
        """Yield (index of the item, function(item, threads)) as they are done; the first error is raised."""

    def __enter__(self) -> Self:
        """Return the executor."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End what the executor has started."""


class Threads:
    """Several items at a time in threads of this process."""

    def __init__(self, threads: int | None = None) -> None:
        self._threads = thread_count(threads)
        self._memory = ExitStack()

    @property
    def slots(self) -> int:
        """How many items are worked on at a time."""
        return self._threads

    @property
    def shares_memory(self) -> bool:
        """Whether all items find in memory what earlier ones have left there: they do."""
        return True

    def map(self, function: Callable[[Item, int], Value], items: Sequence[Item]) -> Iterator[tuple[int, Value]]:
        """Yield (index of the item, function(item, threads)) as they are done.

        Whole items side by side use the processors better than the threads inside one item, much of which is serial.
        Those that begin when fewer are left than there are threads share these.
        """
        side_by_side = max(1, min(self._threads, len(items)))

        def threads(index: int) -> int:
            begins_later = index >= side_by_side
            return self._threads // (min(side_by_side, len(items) - index) if begins_later else side_by_side)

        cv2.setNumThreads(max(1, self._threads // side_by_side))
        pool = ThreadPoolExecutor(side_by_side)
        try:
            futures = {pool.submit(function, item, threads(index)): index for index, item in enumerate(items)}
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            # An interrupt must not wait for what has not begun.
            pool.shutdown(cancel_futures=True)

    def __enter__(self) -> Self:
        RECENT.max_bytes = main_process_bytes()
        self._memory.enter_context(kept_memory())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give back the memory; threads end with each `map`."""
        RECENT.max_bytes = WORKER_BYTES
        RECENT.clear()
        self._memory.close()
