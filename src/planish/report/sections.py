"""Sections of the report: measurements, 3D view, tables, errors against truth, refused pairs."""

from __future__ import annotations

from html import escape

from planish.evaluation import table
from planish.evaluation.overlap import DEFINITION
from planish.evaluation.result import Evaluation
from planish.registration.result import Registration
from planish.report import text
from planish.report.html import html_table, name_tag
from planish.report.scene import Scene


def measurements_section(scene: Scene) -> str:
    """Return the table of the measurements."""
    registration = scene.registration
    references = {g.id: g.reference for g in registration.groups}
    rows = []
    for m, item in zip(registration.measurements, scene.items, strict=True):
        # Where a frame given from outside is the world, the reference is as uncertain as the others.
        reference = references[m.group] == m.name and not m.covariance_noise.any()
        rows.append(
            (
                name_tag(registration, m.name),
                str(m.group),
                f"{item.points:,}",
                f"{item.gsd_mm:.3f}",
                "reference" if reference else f"{text.position_sigma(m):.4f}",
                "" if reference else f"{1000 * text.rotation_sigma(m):.4f}",
            )
        )
    columns = (
        ("measurement", ""), ("group", ""), ("points", ""), ("pixel", "mm"), ("sigma of place", "mm"),
        ("sigma of rotation", "mrad"),
    )  # fmt: skip
    return html_table(columns, rows, raw_first=True)


def view_section(registration: Registration) -> str:
    """Return the 3D view with its controls; `view.js` fills it."""
    boxes = "".join(
        f'<label><input type="checkbox" data-measurement="{i}">{name_tag(registration, m.name)}</label>'
        for i, m in enumerate(registration.measurements)
    )
    modes = (("measurement", "measurement"), ("texture", "texture"), ("error", "overlap error"))
    buttons = "".join(
        f'<label><input type="radio" name="mode" value="{value}"{" checked" if i == 0 else ""}>{label}</label>'
        for i, (value, label) in enumerate(modes)
    )
    note = (
        "Overlap error: mean signed distance from the measurements it overlaps, red = nearer to the sensor than they. "
        "Thinned grid; groups have no common frame."
    )
    return (
        f'<div class="view"><div id="view3d"></div><div class="panel"><h4>Colour</h4><div>{buttons}</div>'
        f'<h4>Measurements</h4><div>{boxes}</div><p class="definition" style="padding:0">{note}</p></div></div>'
    )


def overlap_section(registration: Registration) -> str:
    """Return the table of the overlap errors with its definition."""
    rows = table.pair_rows(registration)
    if not rows:
        return "<p>No pair was accepted.</p>"
    lines = "".join(f"<li>{escape(line)}</li>" for line in DEFINITION)
    return html_table(table.PAIR_COLUMNS, rows) + f'<ul class="definition">{lines}</ul>'


def truth_section(evaluation: Evaluation) -> str:
    """Return the table of the starting paper with its definition."""
    findings = "".join(
        f'<p class="{"bad" if f.startswith("WRONG") else "warn"}">{escape(f)}</p>' for f in evaluation.findings
    )
    return (
        "<h2>Errors against truth</h2>"
        + (findings or "<p>Nothing wrong, nothing missing.</p>")
        + '<div class="columns">'
        + html_table(table.TRUTH_PAIR_COLUMNS, table.truth_pair_rows(evaluation))
        + html_table(table.TRUTH_MEASUREMENT_COLUMNS, table.truth_measurement_rows(evaluation))
        + "</div>"
    )


def refused_section(registration: Registration) -> str:
    """Return the refused pairs with their reasons."""
    rows = [
        (f"{p.a}, {p.b}", p.reason, str(p.matches), str(p.consensus))
        for p in registration.pairs
        if p.status == "refused"
    ]
    if not rows:
        return ""
    columns = (("pair", ""), ("reason", ""), ("matches", ""), ("consensus", ""))
    return "<h2>Refused pairs</h2>" + html_table(columns, rows, "text")
