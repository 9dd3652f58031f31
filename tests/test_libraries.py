"""Threads of libraries while planish works."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
from threadpoolctl import threadpool_info

from planish.execution.libraries import serial_linear_algebra


def blas_threads() -> set[int]:
    return {item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"}


def test_linear_algebra_takes_one_thread_inside_and_as_many_as_before_afterwards() -> None:
    before = blas_threads()
    with serial_linear_algebra():
        assert blas_threads() == {1}
        with serial_linear_algebra():
            pass
        assert blas_threads() == {1}
    assert blas_threads() == before


def test_the_last_of_overlapping_blocks_gives_the_threads_back() -> None:
    before, both, one_left = blas_threads(), Barrier(2), Barrier(2)

    def leave_first() -> None:
        with serial_linear_algebra():
            both.wait()
        one_left.wait()

    def leave_last() -> set[int]:
        with serial_linear_algebra():
            both.wait()
            one_left.wait()
            return blas_threads()

    with ThreadPoolExecutor(2) as pool:
        first, last = pool.submit(leave_first), pool.submit(leave_last)
        first.result()
        assert last.result() == {1}
    assert blas_threads() == before


def test_an_error_inside_gives_the_threads_back() -> None:
    before = blas_threads()
    with pytest.raises(KeyError), serial_linear_algebra():
        raise KeyError
    assert blas_threads() == before


def test_threads_that_the_user_has_allowed_come_back() -> None:
    """In a process of its own: elsewhere the libraries may have one thread already."""
    code = (
        "from test_libraries import blas_threads\n"
        "from planish.execution.libraries import serial_linear_algebra\n"
        "with serial_linear_algebra():\n"
        "    inside = blas_threads()\n"
        "print(inside, blas_threads())\n"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "PYTHONPATH": os.path.dirname(__file__)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "{1} {2}\n"
