"""The section of the report on accepted and ambiguous pairs."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

from planish.registration.result import PairResult, Registration
from planish.report import text
from planish.report.figures import MAX_LINES
from planish.report.html import figure, figure_name, html_table, name_tag

#: Pairs shown with pictures inside the page; those of all others lie in `figures/` only.
MAX_PAIRS_WITH_PICTURES = 12


def pairs_section(registration: Registration, pictures: Mapping[str, bytes]) -> str:
    """Return the accepted and ambiguous pairs, each with its pictures as far as `pictures` holds them."""
    parts = [_pair(registration, pair, pictures) for pair in registration.pairs if pair.status != "refused"]
    return "".join(parts) or "<p>No pair was accepted.</p>"


def pictures_inside(registration: Registration) -> set[str]:
    """Return the file names of the pictures that the page itself shows."""
    shown = [p for p in registration.pairs if p.status != "refused"][:MAX_PAIRS_WITH_PICTURES]
    return {figure_name(kind, pair) for pair in shown for kind in ("matches", "histogram")}


def _pair(registration: Registration, pair: PairResult, pictures: Mapping[str, bytes]) -> str:
    """Return the accepted and ambiguous pairs, each with its pictures as far as `pictures` holds them."""
    title = f"{name_tag(registration, pair.a)} &nbsp; {name_tag(registration, pair.b)}"
    parts = [
        f'<section class="pair"><h3>{title} &nbsp;<span class="status {pair.status}">{pair.status}</span></h3>',
        f"<p>{escape(pair.reason)}</p>",
        *(f'<p class="warn">{escape(r)}</p>' for r in text.remarks(pair) if pair.status == "accepted"),
        f'<p class="muted">{pair.matches} matches, {pair.consensus} in consensus, log10 of the expected false alarms '
        f"{pair.log10_false_alarms:.1f}{_runner_up(pair)}</p>",
    ]
    matches = pictures.get(figure_name("matches", pair))
    if matches is not None:
        caption = f"Texture of {pair.a} (left) and {pair.b} (right)"
        if len(pair.matches_px):
            caption += f"; orange: consensus, blue: other matches, at most {MAX_LINES} of each"
        parts.append(figure(matches, caption + "."))
    parts.append('<div class="columns">')
    histogram = pictures.get(figure_name("histogram", pair))
    if histogram is not None:
        parts.append(figure(histogram, "Overlap error: signed distance along the normal, all points.", 440))
    parts += [_observability(pair), _transform(pair), "</div></section>"]
    return "".join(parts)


def _runner_up(pair: PairResult) -> str:
    other = pair.runner_up
    if other is None:
        return ""
    return (
        f"; next best contradicting consensus: {other.consensus} matches, "
        f"{np.degrees(other.rotation_rad):.2f}° "
        f"and {other.translation_mm:.2f} mm away"
    )


def _observability(pair: PairResult) -> str:
    if not pair.observability:
        return ""
    rows = [
        (
            d.motion,
            f"{d.sigma_mm:.4f}",
            f"{100 * d.texture_share:.0f}",
            d.held_by,
        )
        for d in pair.observability
    ]
    columns = (("motion", ""), ("sigma", "mm"), ("by texture", "%"), ("held", ""))
    return f'<div>{html_table(columns, rows)}<p class="definition" style="padding:0">{_LEVER}</p></div>'


_LEVER = "Rotations: motion at the edge of the overlap. Axes in the frame of the first measurement."


def _transform(pair: PairResult) -> str:
    if pair.T_a_b is None:
        return ""
    rows = "".join("<tr>" + "".join(f"<td>{v:.6f}</td>" for v in row) + "</tr>" for row in pair.T_a_b)
    head = f'<p class="muted">T_a_b (points of {escape(pair.b)} into {escape(pair.a)}): {text.motion(pair)}</p>'
    return f'<div>{head}<table class="matrix">{rows}</table></div>'
