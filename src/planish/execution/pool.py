"""A pool of worker processes on this machine; what a killed worker was at is done again by another one.

Workers are fresh interpreters, never copies of this process: a copy may inherit locks that threads hold which it does
not have. They need not import the caller's script either.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Self, TypeVar

from planish.errors import InputError
from planish.execution.worker import read_message
from planish.options import thread_count

Item = TypeVar("Item")
Value = TypeVar("Value")

#: An item that so many workers died of is given up: it is the item, not chance.
MAX_ATTEMPTS = 3


class WorkerLostError(RuntimeError):
    """A worker process has ended without an answer."""


class Worker:
    """One worker process and the pipes to it."""

    def __init__(self) -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "planish.execution.worker"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment,
        )  # fmt: skip

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def call(self, function: Callable[[Any, int], Any], item: Any, threads: int) -> Any:
        """Return function(item, threads), computed by the worker; its errors are raised here."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        content = pickle.dumps((function, item, threads))
        try:
            stdin.write(len(content).to_bytes(8, "little") + content)
            stdin.flush()
            answer = read_message(stdout)  # type: ignore[arg-type]
        except (OSError, ValueError):
            answer = None
        if answer is None:
            raise WorkerLostError(f"worker process {self.pid} has ended (exit code {self._process.wait()})")
        good, value = pickle.loads(answer)
        if not good:
            raise value
        return value

    def stop(self) -> None:
        """End the process at once: what it has finished lies in files, what it has not is done again."""
        self._process.kill()
        self._process.wait()


class Stretches:
    """Items 0 to n - 1 in neighbouring stretches, one per slot, each with the number of the attempt."""

    def __init__(self, count: int, slots: int) -> None:
        bounds = [slot * count // max(1, slots) for slot in range(slots + 1)]
        self._waiting = [deque((index, 1) for index in range(*pair)) for pair in pairwise(bounds)]
        self._lock = threading.Lock()

    def take(self, slot: int) -> tuple[int, int] | None:
        """Return the next item of a slot, else the last one of the slot with the most left, else None."""
        with self._lock:
            if self._waiting[slot]:
                return self._waiting[slot].popleft()
            longest = max(self._waiting, key=len)
            return longest.pop() if longest else None

    def give_back(self, slot: int, index: int, attempt: int) -> None:
        """Let an item be taken again, by this slot first."""
        with self._lock:
            self._waiting[slot].appendleft((index, attempt))


class WorkerPool:
    """`workers` processes, each with its share of `threads`, started when first needed."""

    def __init__(self, workers: int, threads: int | None = None) -> None:
        if workers < 1:
            raise InputError("workers", f"found {workers}", "a whole number >= 1")
        self._own_threads = max(1, thread_count(threads) // workers)
        self._workers: list[Worker | None] = [None] * workers

    @property
    def slots(self) -> int:
        """How many items are worked on at a time."""
        return len(self._workers)

    @property
    def shares_memory(self) -> bool:
        """Whether all items find in memory what earlier ones have left there: only those of one process do."""
        return False

    @property
    def pids(self) -> list[int]:
        """Numbers of the worker processes that run."""
        return [worker.pid for worker in self._workers if worker is not None]

    def map(self, function: Callable[[Item, int], Value], items: Sequence[Item]) -> Iterator[tuple[int, Value]]:
        """Yield (index of the item, function(item, threads)) as they are done; the first error is raised.

        Each worker goes through neighbouring items, which may share what it keeps in memory; one that is ready takes
        over from the end of what another one still has before it.
        """
        slots = min(len(items), len(self._workers))
        waiting = Stretches(len(items), slots)
        answers: SimpleQueue[tuple[int, Value | None, BaseException | None]] = SimpleQueue()
        given_up = threading.Event()

        def serve(slot: int) -> None:
            while not given_up.is_set():
                taken = waiting.take(slot)
                if taken is None:
                    return
                index, attempt = taken
                try:
                    answers.put((index, self._call(slot, function, items[index]), None))
                except WorkerLostError as error:
                    if attempt < MAX_ATTEMPTS:
                        waiting.give_back(slot, index, attempt + 1)
                    else:
                        answers.put((index, None, error))
                except Exception as error:
                    answers.put((index, None, error))

        threads = [threading.Thread(target=serve, args=(slot,), daemon=True) for slot in range(slots)]
        for thread in threads:
            thread.start()
        try:
            for _ in items:
                index, value, error = answers.get()
                if error is not None:
                    raise error
                yield index, value  # type: ignore[misc]
        except BaseException:
            # An error, an interrupt, or nobody who wants the rest.
            given_up.set()
            self._stop()
            raise
        finally:
            for thread in threads:
                thread.join()

    def _call(self, slot: int, function: Callable[[Item, int], Value], item: Item) -> Value:
        worker = self._workers[slot]
        if worker is None:
            worker = self._workers[slot] = Worker()
        try:
            value: Value = worker.call(function, item, self._own_threads)
            return value
        except WorkerLostError:
            self._workers[slot] = None
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all workers."""
        self._stop()

    def _stop(self) -> None:
        for slot, worker in enumerate(self._workers):
            if worker is not None:
                worker.stop()
                self._workers[slot] = None
