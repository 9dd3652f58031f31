"""The peers' own environment: another Python with their packages."""

from __future__ import annotations

import subprocess


def check_environment(python: str, *modules: str) -> None:
    """Exit with what is missing if `python` cannot import the modules, before hours are spent without them."""
    try:
        done = subprocess.run(
            [python, "-c", f"import {', '.join(modules)}"], capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise SystemExit(f"--peers {python}: cannot be run: {error}") from None
    if done.returncode != 0:
        raise SystemExit(f"--peers {python}: cannot import {', '.join(modules)}:\n{done.stderr}")
