"""Functions for executors to run: at the top of a module, so that other processes find them."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from planish.errors import InputError


def square(item, threads):
    assert threads >= 1
    return item * item


def threads_given(item, threads):
    return threads


def refuse(item, threads):
    raise InputError("item", f"found {item}", "another one")


def die_first(item, threads):
    """Kill the own process the first time a marker file does not exist; then return what `item` holds."""
    marker, value = item
    if not Path(marker).exists():
        Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def die_always(item, threads):
    os.kill(os.getpid(), signal.SIGKILL)


def print_much(item, threads):
    """What is printed must not get between the answers."""
    os.write(1, b"noise" * 1000)
    return item
