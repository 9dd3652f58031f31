"""The command line: one file per command; `main` turns every InputError into a message and exit code 2."""

from __future__ import annotations

import signal
import sys
from importlib import import_module, metadata
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console

from planish.errors import InputError

#: One module per command; each has a function `register_command(app)`.
COMMANDS: tuple[str, ...] = (
    "patterns",
    "simulate",
    "simulate_board",
    "calibrate",
    "measure",
    "check_rig",
    "import_cloud",
    "convert_rig",
    "register",
    "evaluate",
    "demo",
)

#: Messages and progress go to stderr; stdout carries results (tables) only.
console = Console(stderr=True)


class Interrupted(BaseException):
    """Ctrl-C: passes through the command-line library, which would exit with 1."""


def make_app() -> typer.Typer:
    """Return the application with all commands."""
    app = typer.Typer(
        no_args_is_help=True,
        invoke_without_command=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        help="Measure by fringe projection; register the measurements by their surface texture.",
    )
    app.callback()(_common)
    for command in COMMANDS:
        import_module(f"planish.cli.{command}").register_command(app)
    return app


def _common(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False,
) -> None:
    if version:
        typer.echo(f"planish {metadata.version('planish')}")
        raise typer.Exit


def main() -> None:
    """Run the command line: exit codes 0 done, 2 bad input, 3 with --require-all, 130 interrupted."""
    signal.signal(signal.SIGINT, _interrupt)
    try:
        make_app()()
    except InputError as error:
        console.print("error:", style="bold red", end=" ")
        console.print(str(error), highlight=False, markup=False, soft_wrap=True)
        sys.exit(2)
    except Interrupted:
        console.print("interrupted; finished results are kept")
        sys.exit(130)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise Interrupted
