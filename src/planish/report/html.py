"""Pieces of HTML that several sections of the report use."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

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


def html_table(columns: Sequence[tuple[str, str]], rows: Cells, kind: str = "", raw_first: bool = False) -> str:
    """Return an HTML table; cells are escaped, the first one only unless `raw_first`."""
    head = "".join(f"<th>{escape(name)}{f' [{unit}]' if unit else ''}</th>" for name, unit in columns)
    lines = []
    for row in rows:
        cells = [cell if raw_first and i == 0 else escape(cell) for i, cell in enumerate(row)]
        lines.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table>'


def name_tag(registration: Registration, name: str) -> str:
    """Return the name of a measurement with its colour."""
    index = [m.name for m in registration.measurements].index(name)
    return f'<span class="dot" style="background:{colour(index)}"></span>{escape(name)}'
