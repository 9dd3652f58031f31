"""Stages on a Dask cluster: any number of machines that see the same files under the same names."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import cv2

from planish.errors import InputError
from planish.execution.libraries import serial_linear_algebra
from planish.execution.store import code_version

Item = TypeVar("Item")
Value = TypeVar("Value")

#: The scheduler answers within this time or is not there [s].
CONNECT_S = 20


class DaskCluster:
    """Runs items on the workers of a Dask scheduler (`tcp://host:port`); lost workers' items run elsewhere."""

    def __init__(self, address: str) -> None:
        try:
            # An extra: most users need one machine only.
            import distributed
        except ImportError:
            raise InputError(
                "cluster", "the package dask.distributed is not installed", "pip install 'planish[cluster]'"
            ) from None
        try:
            self._distributed: Any = distributed
            self._client: Any = self._distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                "cluster", f"no scheduler answers at {address!r} ({error})", "a Dask scheduler, tcp://host:port"
            ) from None

    @property
    def slots(self) -> int:
        """How many items are worked on at a time."""
        return max(1, sum(self._client.nthreads().values()))

    @property
    def shares_memory(self) -> bool:
        """Whether all items find in memory what earlier ones have left there: only those of one process do."""
        return False

    def map(self, function: Callable[[Item, int], Value], items: Sequence[Item]) -> Iterator[tuple[int, Value]]:
        """Yield (index of the item, function(item, threads)) as they are done; the first error is raised."""
        # The scheduler remembers results by key: pure functions of files would be taken for done when files are gone.
        futures = {
            self._client.submit(call_if_same_code, function, item, code_version(), pure=False): i
            for i, item in enumerate(items)
        }
        try:
            for future in self._distributed.as_completed(list(futures), loop=self._client.loop):
                yield futures[future], future.result()
        finally:
            self._client.cancel(list(futures))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the cluster; it goes on for others."""
        self._client.close()


def call_if_same_code(function: Callable[[Item, int], Value], item: Item, code: str) -> Value:
    """Return function(item, threads) on a worker whose code is that of the caller; else raise InputError."""
    if code_version() != code:
        raise InputError("cluster", "a worker runs another planish, NumPy, SciPy or OpenCV", "the same everywhere")
    # A Dask worker runs as many items as it has threads: one thread for each of them.
    cv2.setNumThreads(1)
    with serial_linear_algebra():
        return function(item, 1)
