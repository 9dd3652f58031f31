"""Pieces of HTML that several sections of the report use."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

from planish.registration.result import PairResult, Registration
from planish.report.style import colour

Cells = Sequence[Sequence[str]]


def figure_name(kind: str, pair: PairResult) -> str:
    """Return the file name of a pair's picture."""
    return f"{kind}_{pair.a}_{pair.b}.png"


def figure(content: bytes, caption: str, width: int | None = None) -> str:
    """Return a PNG with its caption, embedded."""
    size = f' style="width:{width}px"' if width else ""
    image = (
        f'<img alt="{escape(caption)}" src="data:image/png;base64,{base64.b64encode(content).decode("ascii")}"{size}>'
    )
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def html_table(
    columns: Sequence[tuple[str, str]],
    rows: Cells,
    kind: str = "",
    raw_first: bool = False,
    row_kinds: Sequence[str] = (),
) -> str:
    """Return an HTML table; cells are escaped, the first one only unless `raw_first`.

    `kind` is the class of the table, `row_kinds` those of its rows.
    """
    head = "".join(f"<th>{escape(name)}{f' [{unit}]' if unit else ''}</th>" for name, unit in columns)
    lines = []
    for number, row in enumerate(rows):
        cells = [cell if raw_first and i == 0 else escape(cell) for i, cell in enumerate(row)]
        own = f' class="{row_kinds[number]}"' if number < len(row_kinds) and row_kinds[number] else ""
        lines.append(f"<tr{own}>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table>'


def details(title: str, content: Mapping[str, object]) -> str:
    """Return a folded block of JSON."""
    return f"<details><summary>{title}</summary><pre>{escape(json.dumps(content, indent=2))}</pre></details>"


def html_page(title: str, body: Sequence[str], scripts: Sequence[str] = ()) -> str:
    """Return a whole page with the style of all reports."""
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title><style>{asset('style.css')}</style></head><body><main>",
            *body,
            f"</main>{chr(10).join(scripts)}</body></html>",
        ]
    )


def asset(name: str) -> str:
    """Return the text of a file that lies beside the report's modules."""
    return files("planish.report").joinpath(name).read_text(encoding="utf-8")


def name_tag(registration: Registration, name: str) -> str:
    """Return the name of a measurement with its colour."""
    index = [m.name for m in registration.measurements].index(name)
    return f'<span class="dot" style="background:{colour(index)}"></span>{escape(name)}'
