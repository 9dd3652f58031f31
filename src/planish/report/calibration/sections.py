"""Sections of the calibration's report: advice, expected error, views, outliers, lens models, what the board says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from planish.measurement import Finding
from planish.report.calibration import text
from planish.report.calibration.figures import view_rms
from planish.report.calibration.numbers import percent, pixel_digits, prose, significant, with_sigma
from planish.report.html import html_table
from planish.report.text import count
from planish.sensing.calibrate.judge.advice import bad_views, device_title
from planish.sensing.calibrate.judge.expected_error import ExpectedError, map_rms
from planish.sensing.calibrate.judge.point_sigmas import point_sigmas
from planish.sensing.calibrate.judge.views import placements
from planish.sensing.calibrate.result import Calibration

#: Outliers listed one by one, the largest first.
MAX_OUTLIERS = 25


def warnings_section(findings: Sequence[Finding]) -> str:
    """Return the warnings of the findings; empty without any."""
    return "".join(f'<p class="warn">{prose(f.warning)}</p>' for f in findings if f.warning)


def advice_section(sentences: Sequence[str]) -> str:
    """Return the advice as a list."""
    if not sentences:
        return "<p>Number, places, tilts and depths of the views leave nothing to be advised.</p>"
    return "<ul>" + "".join(f"<li>{prose(s)}</li>" for s in sentences) + "</ul>"


def error_section(calibration: Calibration, errors: Sequence[ExpectedError], pictures: Mapping[str, str]) -> str:
    """Return the expected 3D error: definitions, table and one picture per pair of devices."""
    columns = (
        ("points by", ""), ("form, rms", "mm"), ("worst", "mm"), ("of it scale, rms", "mm"), ("warp, rms", "mm"),
        ("sensor frame, rms", "mm"), ("worst", "mm"), ("sigma of the scale", ""),
    )  # fmt: skip
    rows = [
        (
            f"{device_title(e.own)}, {device_title(e.other)}",
            *(
                significant(v)
                for v in (
                    map_rms(e.form_mm), _worst(e.form_mm), map_rms(e.scale_mm), map_rms(e.warp_mm),
                    map_rms(e.sensor_mm), _worst(e.sensor_mm),
                )
            ),
            percent(e.scale_sigma),
        )
        for e in errors
    ]  # fmt: skip
    lines = "".join(f"<li>{escape(line)}</li>" for line in text.ERROR_DEFINITION)
    shown = "".join(pictures[f"expected_error_{e.own}_{e.other}"] for e in errors)
    return html_table(columns, rows) + shown + f'<ul class="definition">{lines}</ul>'


def _worst(values: np.ndarray) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def views_section(calibration: Calibration) -> str:
    """Return the table of the views, the worst first; conspicuous ones stand out."""
    devices = list(calibration.rig.devices)
    rms = {d: view_rms(calibration, d) for d in devices}
    bad = {d: bad_views(calibration, d) for d in devices}
    median = {d: np.nanmedian(list(rms[d].values())) for d in devices}
    places = {p.view: p for p in placements(calibration)}

    def badness(view: str) -> float:
        return max((rms[d][view] / median[d] for d in devices if np.isfinite(rms[d][view])), default=0.0)

    lines = []
    for view in sorted(places, key=lambda name: -badness(name)):
        cells = [f"<td>{escape(view)}</td>", f"<td>{places[view].distance_mm:.0f}</td>",
                 f"<td>{np.degrees(places[view].tilt_rad):.0f}</td>"]  # fmt: skip
        for d in devices:
            points, outliers = _counts(calibration, view, d)
            mark = ' class="bad"' if view in bad[d] else ""
            value = f"{rms[d][view]:.{pixel_digits(median[d])}f}" if np.isfinite(rms[d][view]) else "–"
            cells += [
                f'<td class="start">{points or "–"}</td>',
                f"<td{mark}>{value}</td>",
                f"<td>{outliers or ''}</td>",
            ]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    top = "".join(f'<th colspan="3" class="group">{escape(device_title(d))}</th>' for d in devices)
    below = '<th class="start">points</th><th>rms [px]</th><th>outliers</th>' * len(devices)
    return (
        f'<table class="small"><thead><tr><th rowspan="2">view</th><th rowspan="2">distance [mm]</th>'
        f'<th rowspan="2">tilt [°]</th>{top}</tr><tr>{below}</tr></thead><tbody>{"".join(lines)}</tbody></table>'
    )


def _counts(calibration: Calibration, view: str, device: str) -> tuple[int, int]:
    own = [r for r in calibration.residuals if r.view == view and r.device == device]
    return sum(int((~r.outlier).sum()) for r in own), sum(int(r.outlier.sum()) for r in own)


def outliers_section(calibration: Calibration) -> str:
    """Return the largest outliers one by one."""
    columns = calibration.observations.board.grid[0]
    found = []
    pairs = [pair for device in calibration.rig.devices for pair in point_sigmas(calibration, device)]
    for r, sigma in pairs:
        for i in np.flatnonzero(r.outlier):
            length = float(np.linalg.norm(r.residual_px[i]))
            device = device_title(r.device) + (f" through camera {r.through}" if r.through else "")
            row, column = divmod(int(r.index[i]), columns)
            u, v = r.pixel_px[i]
            du, dv = r.residual_px[i]
            sigmas = length / sigma[i]
            found.append((sigmas, (r.view, device, f"{column}, {row}", f"{u:.1f}, {v:.1f}", f"{du:+.3f}", f"{dv:+.3f}",
                                   f"{sigmas:.0f}")))  # fmt: skip
    total = sum(len(r.outlier) for r in calibration.residuals)
    if not found:
        return f"<p>None of {total:,} points was left out.</p>"
    found.sort(key=lambda item: -item[0])
    head = f"<p>{len(found)} of {total:,} points ({percent(len(found) / total)}) were left out of the adjustment."
    head += f" The {MAX_OUTLIERS} largest:</p>" if len(found) > MAX_OUTLIERS else "</p>"
    titles = (
        ("view", ""), ("device", ""), ("board point (column, row)", ""), ("at (u, v)", "px"), ("residual u", "px"),
        ("residual v", "px"), ("length over sigma", ""),
    )  # fmt: skip
    return head + html_table(titles, [row for _, row in found[:MAX_OUTLIERS]], "small second-left")


def missed_section(calibration: Calibration) -> str:
    """Return the images that were not used, with reasons."""
    missed = calibration.observations.missed
    if not missed:
        return "<p>All images were used.</p>"
    head = f"<p>{count(len(missed), 'image')} {'was' if len(missed) == 1 else 'were'} not used.</p>"
    return head + html_table((("image", ""), ("reason", "")), list(missed.items()), "text")


def models_section(calibration: Calibration) -> str:
    """Return the lens models with their cross-validation."""
    devices = [d for d in calibration.rig.devices if d in calibration.models]
    names = list(dict.fromkeys(name for d in devices for name in calibration.models[d].left_out_rms_px))
    lines = []
    for name in names:
        cells = [f"<td>{escape(name)}</td>"]
        for d in devices:
            value = calibration.models[d].left_out_rms_px.get(name)
            chosen = ' class="chosen"' if name == calibration.models[d].name else ""
            cells.append(f"<td{chosen}>{'–' if value is None else f'{value:.4f}'}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(f"<th>{escape(device_title(d))} [px]</th>" for d in devices)
    rows = [
        (device_title(d), calibration.models[d].name, " ".join(calibration.models[d].coefficients) or "none",
         calibration.models[d].sentence)
        for d in devices
    ]  # fmt: skip
    chosen = html_table((("device", ""), ("model", ""), ("free coefficients", ""), ("why", "")), rows, "text")
    if not names:
        return chosen
    return chosen + (
        "<p>Root mean square (2-D) of boards that were left out of the adjustment, per model; bold: chosen.</p>"
        f"<table><thead><tr><th>model</th>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    )


def findings_section(calibration: Calibration) -> str:
    """Return what the boards say about themselves."""
    if not calibration.findings:
        return ""
    rows = []
    for f in calibration.findings:
        value, sigma = ("not observable", "") if f.value is None else with_sigma(f.value, f.sigma)
        rows.append((f.quantity, value, sigma, f.unit, f.source))
    kinds = ["warned" if f.warning else "" for f in calibration.findings]
    columns = (("quantity", ""), ("value", ""), ("sigma", ""), ("unit", ""), ("how it was found", ""))
    return html_table(columns, rows, "findings", row_kinds=kinds)
