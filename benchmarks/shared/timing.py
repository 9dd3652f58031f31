"""Seconds of a call, the same way in every benchmark."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import TypeVar

Value = TypeVar("Value")


def timed(
    function: Callable[[], Value], runs: int, clock: Callable[[], float] = time.perf_counter
) -> tuple[float, Value]:
    """Return the median seconds of a call after one that does not count, and what that one returned."""
    found = function()
    seconds = []
    for _ in range(runs):
        started = clock()
        function()
        seconds.append(clock() - started)
    return median(seconds), found
