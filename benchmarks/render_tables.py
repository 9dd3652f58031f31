"""Tables in the documents come from saved results, never typed by hand.

A benchmark saves its result with `save_table`; `python benchmarks/render_tables.py` (or `make tables`) then fills every
block of the Markdown files that reads

    <!-- table: NAME -->
    <!-- end -->

from benchmarks/results/NAME.json. A test fails where a document and its results differ.
"""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = Path(__file__).resolve().parent / "results"
BLOCK = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
MISSING = "-"


def save_table(
    name: str,
    columns: Mapping[str, str],
    rows: Sequence[Mapping[str, Any]],
    command: str,
    formats: Mapping[str, str] | None = None,
    folder: Path = RESULTS,
    machine: str | None = None,
) -> Path:
    """Save a table as JSON.

    Parameters
    ----------
    name : str
        Name of the table: letters, digits, `_` and `-`.
    columns : mapping of str to str
        Key to heading, with the unit, in order.
    rows : sequence of mappings
        One value per key; None or nothing where there is none.
    command : str
        What to run to get the figures again.
    formats : mapping of str to str
        Key to format of its numbers, for example ".3f"; default as they are.
    machine : str, optional
        Where the figures were found; default this machine.
    """
    content = {
        "command": command,
        "machine": machine or describe_machine(),
        "columns": dict(columns),
        "formats": dict(formats or {}),
        "rows": [dict(row) for row in rows],
    }
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.json"
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path


def describe_machine() -> str:
    """Return processor, number of processors and Python in words."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.is_file():
        names = re.findall(r"model name\s*:\s*(.+)", information.read_text())
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} processors, Python {platform.python_version()}"


def render_table(content: Mapping[str, Any]) -> str:
    """Return a saved table as Markdown, with its origin below."""
    columns, formats = content["columns"], content["formats"]
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + "---|" * len(columns)]
    for row in content["rows"]:
        cells = [_cell(row.get(key), formats.get(key, "")) for key in columns]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", f"Measured by `{content['command']}` ({content['machine']}).", ""])


def _cell(value: Any, form: str) -> str:
    if value is None:
        return MISSING
    return format(value, form if isinstance(value, (int, float)) else "").replace("|", "\\|")


def fill_blocks(text: str, results: Path = RESULTS) -> str:
    """Return a document with all its table blocks filled; a block without results is an error."""

    def filled(match: re.Match[str]) -> str:
        path = results / f"{match[2]}.json"
        if not path.is_file():
            raise FileNotFoundError(f"the table '{match[2]}' has no results: {path} is missing")
        return match[1] + render_table(json.loads(path.read_text(encoding="utf-8"))) + match[3]

    return BLOCK.sub(filled, text)


def documents(root: Path = ROOT) -> Iterator[Path]:
    """Yield the Markdown files of the project."""
    yield from sorted(root.glob("*.md"))
    for folder in ("docs", "benchmarks", "examples"):
        yield from sorted((root / folder).rglob("*.md"))


def main() -> None:
    """Fill the tables of all documents in place."""
    for path in documents():
        text = path.read_text(encoding="utf-8")
        new = fill_blocks(text)
        if new != text:
            path.write_text(new, encoding="utf-8")
            print(f"filled {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
