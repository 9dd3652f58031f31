"""`rig_report.html`: verdict, advice, figures and tables of a calibration in one file that needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from planish.report.calibration import text
from planish.report.calibration.figures import coverage_png, height_png, placement_png, residuals_png, views_png
from planish.report.calibration.maps import distortion_png, error_png
from planish.report.calibration.numbers import prose
from planish.report.calibration.parameters import covered_parameters, parameter_tables
from planish.report.calibration.sections import (
    advice_section,
    error_section,
    findings_section,
    missed_section,
    models_section,
    outliers_section,
    views_section,
    warnings_section,
)
from planish.report.html import details, figure, html_page
from planish.report.style import save_bytes
from planish.sensing.calibrate.judge.advice import advice, device_title
from planish.sensing.calibrate.judge.coverage import coverage
from planish.sensing.calibrate.judge.expected_error import ExpectedError, expected_errors
from planish.sensing.calibrate.result import Calibration

#: Widths in the page of pictures that are narrower than it: the board's height, one device's panel [px].
HEIGHT_WIDTH_PX, PANEL_WIDTH_PX = 620, 374


def write_calibration_report(calibration: Calibration, path: Path, versions: Mapping[str, str] | None = None) -> Path:
    """Write the page `path` and, beside it, its pictures as `figures/<name of the page>_*.png`; return `path`.

    Parameters
    ----------
    calibration : Calibration
        What is reported.
    path : Path
        For example `rig_report.html`; its folder is made where it is missing.
    versions : mapping of str
        Versions that the result depends on, for the record.
    """
    path = Path(path)
    errors = expected_errors(calibration)
    pictures = _pictures(calibration, errors)
    prefix = path.stem.removesuffix("_report")
    for name, content in pictures.items():
        save_bytes(path.parent / "figures" / f"{prefix}_{name}.png", content)
    save_bytes(path, _page(calibration, errors, pictures, dict(versions or {})).encode("utf-8"))
    return path


def _pictures(calibration: Calibration, errors: Sequence[ExpectedError]) -> dict[str, bytes]:
    devices = calibration.rig.devices
    maps = {name: coverage(calibration, name) for name in devices}
    pictures = {f"residuals_{name}": residuals_png(calibration, maps[name]) for name in devices}
    for error in errors:
        name = f"expected_error_{error.own}_{error.other}"
        pictures[name] = error_png(error, devices[error.own].size_px)
    pictures["coverage"] = coverage_png(calibration, list(maps.values()))
    pictures["placement"] = placement_png(calibration)
    pictures["views"] = views_png(calibration)
    pictures["distortion"] = distortion_png(devices)
    height = height_png(calibration)
    return pictures if height is None else {**pictures, "height": height}


def _page(
    calibration: Calibration, errors: Sequence[ExpectedError], pictures: Mapping[str, bytes], versions: dict[str, str]
) -> str:
    kind, sentences = text.verdict(calibration, errors)
    summary = "".join(f"<p>{prose(s)}</p>" for s in sentences)
    version = versions.get("planish")
    subtitle = f"planish{f' {version}' if version else ''}, all lengths in millimetres, residuals in pixels"
    shown = _shown(calibration, errors, pictures)
    body = [
        "<h1>Calibration report</h1>",
        f'<p class="muted">{escape(subtitle)}</p>',
        f'<div class="summary {kind}">{summary}</div>',
        warnings_section(calibration.findings),
        "<h2>Advice</h2>",
        advice_section(advice(calibration, errors)),
        *(("<h2>Expected 3D error</h2>", error_section(calibration, errors, shown)) if errors else ()),
        "<h2>Residuals</h2>",
        f"<p>{prose(text.RESIDUALS)}</p>",
        *(shown[f"residuals_{name}"] for name in calibration.rig.devices),
        "<h2>Views</h2>",
        shown["views"],
        views_section(calibration),
        "<h2>Coverage of image, depth and tilt</h2>",
        shown["coverage"],
        shown["placement"],
        "<h2>Outliers</h2>",
        outliers_section(calibration),
        "<h2>Images that were not used</h2>",
        missed_section(calibration),
        "<h2>Lens models</h2>",
        models_section(calibration),
        shown["distortion"],
        "<h2>Parameters</h2>",
        parameter_tables(calibration),
        f'<p class="definition">Standard deviations with all other parameters free; the covariance in the rig file '
        f"holds {covered_parameters(calibration.rig)} parameters, the others were kept as they are.</p>",
        "<h2>What the boards say about themselves</h2>",
        findings_section(calibration),
        shown.get("height", ""),
        "<h2>Options and versions</h2>",
        details("options of this run", calibration.options),
        details("versions", versions),
    ]
    return html_page("Calibration report", body)


def _shown(calibration: Calibration, errors: Sequence[ExpectedError], pictures: Mapping[str, bytes]) -> dict[str, str]:
    """Return the pictures with their captions, as HTML."""
    captions = {
        "views": "Root mean square of the residuals' length per view; dashed: median; orange: more than twice the "
        "median.",
        "coverage": "Points that count, per cell of the image. Red: none; grey: no other device sees this part of the "
        "image at the working distance, so that nothing is measured there.",
        "placement": "Left: the side of the image to which each board faces, by its tilt. Right: "
        "depths in camera A of the points that were seen.",
        "distortion": "By how much the lens shifts the image.",
        "height": "Height of the board's points above its plane, estimated with the rig.",
    }
    for name in calibration.rig.devices:
        captions[f"residuals_{name}"] = f"{text.capital(device_title(name))}."
    for e in errors:
        captions[f"expected_error_{e.own}_{e.other}"] = (
            f"{text.capital(text.title([e.own]))} with {device_title(e.other)}: expected error over the image of "
            f"{device_title(e.own)}, on a plane at the working distance; grey: not seen by both."
        )
    widths = {"height": HEIGHT_WIDTH_PX}
    for name in ("coverage", "distortion"):
        widths[name] = PANEL_WIDTH_PX * len(calibration.rig.devices)
    return {name: figure(content, captions[name], widths.get(name)) for name, content in pictures.items()}
