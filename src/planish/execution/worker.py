"""A worker process: `python -m planish.execution.worker` takes calls from stdin and answers to stdout."""

from __future__ import annotations

import os
import pickle
import queue
import signal
import threading
from typing import Any, BinaryIO

import cv2

from planish import _core
from planish.execution.libraries import serial_linear_algebra


def main() -> None:
    """Answer calls (function, item, threads) with (True, value) or (False, error), until the caller is gone."""
    # Ctrl-C goes to all processes of a terminal: the caller decides what becomes of the workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # What a library prints must not get between the answers.
    os.dup2(2, 1)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(calls, inbox), daemon=True).start()
    while True:
        content = _answer(inbox.get())
        answers.write(len(content).to_bytes(8, "little") + content)
        answers.flush()
        # Maps of many sizes leave gaps behind that the allocator keeps: they would add up over the calls.
        _core.release_memory()


def read_message(stream: BinaryIO) -> bytes | None:
    """Return the next message of a stream, length first; None where it has ended."""
    head = stream.read(8)
    if len(head) < 8:
        return None
    content = stream.read(int.from_bytes(head, "little"))
    return content if len(content) == int.from_bytes(head, "little") else None


def _listen(calls: BinaryIO, inbox: queue.SimpleQueue[bytes]) -> None:
    while (call := read_message(calls)) is not None:
        inbox.put(call)
    # The caller is gone, perhaps killed: nobody waits for what is being computed.
    os._exit(0)


def _answer(call: bytes) -> bytes:
    try:
        function, item, threads = pickle.loads(call)
        cv2.setNumThreads(threads)
        with serial_linear_algebra():
            return pickle.dumps((True, function(item, threads)))
    except Exception as error:
        return _pickled_error(error)


def _pickled_error(error: Exception) -> bytes:
    answer: tuple[bool, Any] = (False, error)
    try:
        content = pickle.dumps(answer)
        pickle.loads(content)
    except Exception:
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))
    return content


if __name__ == "__main__":
    main()
