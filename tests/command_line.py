"""Run a planish command inside the test's own process, as a user would from the shell."""

from __future__ import annotations

import contextlib
import io
import signal
import sys
from dataclasses import dataclass

from planish.cli import main


@dataclass(frozen=True)
class Outcome:
    """Exit code and what was printed."""

    code: int
    out: str
    err: str


def planish(*arguments: object) -> Outcome:
    """Run `planish ARGUMENTS`; messages of the console follow the redirected streams."""
    old_argv, old_handler = sys.argv, signal.getsignal(signal.SIGINT)
    sys.argv = ["planish", *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()
    code = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    finally:
        sys.argv = old_argv
        signal.signal(signal.SIGINT, old_handler)
    return Outcome(code, out.getvalue(), err.getvalue())
