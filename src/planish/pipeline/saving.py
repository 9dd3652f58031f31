"""Measurements on their way to files: each is written while the next one is made."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from planish.measurement import Measurement

Value = TypeVar("Value")


def save_each(made: Iterable[tuple[Measurement, Path, Value]]) -> Iterator[Value]:
    """Write each measurement to its file while the next one is made; yield the value beside it when it is there.

    Where making the next one fails, what has been made before is written and yielded first. Two at a time are in
    memory.
    """
    remaining = iter(made)
    writing: Future[Value] | None = None
    with ThreadPoolExecutor(1) as writer:
        while True:
            error: Exception | None = None
            try:
                item = next(remaining, None)
            except Exception as failure:
                item, error = None, failure
            if writing is not None:
                yield writing.result()
            if error is not None:
                raise error
            if item is None:
                return
            measurement, path, value = item
            writing = writer.submit(_save, measurement, path, value)


def _save(measurement: Measurement, path: Path, value: Value) -> Value:
    measurement.save(path)
    return value
