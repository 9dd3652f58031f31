"""`planish check-rig`: does the calibration still hold, by what measurements show?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from planish.cli import console
from planish.cli.measure import find_captures
from planish.errors import InputError
from planish.measurement import Measurement
from planish.options import thread_count
from planish.pipeline.checking import check_calibration
from planish.rig.parameters import PROJECTOR
from planish.sensing.capture.manifest import Capture
from planish.sensing.rigcheck.adjust import Adjustment
from planish.sensing.rigcheck.estimates import MAX_LEFT_PX
from planish.sensing.rigcheck.result import MeasurementRows, OrientationError, RigCheck

#: Parts of the image, across and down, of the table of row errors.
PARTS = (5, 3)
VERDICTS = {
    "holds": "The calibration holds.",
    "does not hold": "The calibration does not hold.",
    "not observable": "Whether the calibration holds is not observable.",
}
#: Exit code of --require-holds where the calibration is not said to hold.
NOT_HELD = 3


def check_rig(
    measurements: Annotated[
        list[Path],
        typer.Argument(metavar="MEASUREMENT...", help="Measurements (.h5) of one rig, or captures, to be measured."),
    ],
    adjust: Annotated[
        Path | None, typer.Option(metavar="OUT.json", help="Write the rig with its relative orientation adjusted.")
    ] = None,
    rig: Annotated[
        list[Path] | None,
        typer.Option(help="Calibration of captures, instead of their own; repeated for OpenCV's in several files."),
    ] = None,
    images: Annotated[Path | None, typer.Option(help="Folder the image names of captures are relative to.")] = None,
    require_holds: Annotated[
        bool, typer.Option("--require-holds", help="Exit with 3 unless the calibration holds.")
    ] = False,
    threads: Annotated[int | None, typer.Option(help="Threads; the result does not depend on it.")] = None,
) -> None:
    """Tell whether the calibration still holds: the row error of the cameras, with significance."""
    inputs = read_inputs(measurements, images)
    if rig and any(isinstance(item, Measurement) for item in inputs.values()):
        raise InputError("--rig", "given with a measurement", "captures alone: a measurement was made with its own rig")
    with console.status("checking"):
        checked = check_calibration(inputs, adjust is not None, thread_count(threads), rig or None)
    for line in describe(checked.check):
        typer.echo(line)
    if adjust is not None:
        for line in write_adjusted(checked.adjustment, checked.check, adjust):
            typer.echo(line)
    if require_holds and checked.check.status != "holds":
        raise typer.Exit(NOT_HELD)


def read_inputs(paths: list[Path], images: Path | None) -> dict[str, Measurement | Capture]:
    """Return measurements and captures by the names of their files.

    Raises
    ------
    InputError
        Where a path leads to neither, or is given twice.
    """
    inputs: dict[str, Measurement | Capture] = {}
    for path in paths:
        found: dict[str, Measurement | Capture]
        if path.is_dir() or path.suffix == ".json":
            found = {str(capture.path): capture for capture in find_captures([path], images)}
        else:
            found = {str(path): Measurement.load(path)}
        for name, item in found.items():
            if Path(name).resolve() in {Path(other).resolve() for other in inputs}:
                raise InputError(name, "given twice", "each measurement once: twice, it would count twice")
            inputs[name] = item
    return inputs


def describe(check: RigCheck) -> list[str]:
    """Return the answer as lines of text."""
    lines = [_line(item) for item in check.measurements]
    lines += ["", VERDICTS[check.status], f"  because           {check.reason}"]
    if check.mean_px is not None:
        lines += _figures(check)
        lines += _map(check.measurements)
    lines += [_item("not observable", text, i) for i, text in enumerate(check.not_observable)]
    lines += [_item("advice", text, i) for i, text in enumerate(check.advice)]
    return lines


def _item(label: str, text: str, index: int) -> str:
    return f"  {label if index == 0 else '':<16}  {text}"


def _line(item: MeasurementRows) -> str:
    if item.mean_px is None:
        return f"{item.name}: row error not observable ({item.source})"
    return (
        f"{item.name}: row error {item.mean_px:+.3f} +- {item.sigma_px:.3f} {_unit(item.device)}, varies by "
        f"{item.variation_px:.2f} px over the image ({item.source}, {len(item.error_px)} of {item.searched} places)"
    )


def _unit(device: str) -> str:
    return "projector px" if device == PROJECTOR else f"px in camera {device}"


def _figures(check: RigCheck) -> list[str]:
    assert check.mean_px is not None
    assert check.row_mm is not None
    against = "" if check.rig_sigmas is None else f", {check.rig_sigmas:.1f} against the rig's covariance"
    lines = [
        f"  row error         {check.mean_px:+.3f} +- {check.sigma_px:.3f} px, varies by {check.variation_px:.3f} px "
        "over the image",
        f"  significance      {check.noise_sigmas:.1f} standard deviations against noise{against}",
        f"  in millimetres    {1000 * abs(check.mean_px * check.row_mm):.0f} um across the epipolar lines at "
        f"{check.distance_mm:.0f} mm",
    ]
    if check.orientation is not None and (check.unexplained_px or 0.0) <= MAX_LEFT_PX:
        lines += _orientation(check.orientation)
    lines.append(
        f"  not explained     {check.unexplained_px:.3f} px of pattern over the image, "
        f"{check.unexplained_sigmas:.1f} standard deviations"
    )
    return lines


def _orientation(found: OrientationError) -> list[str]:
    sigma = np.degrees(np.sqrt(np.diag(found.covariance)))
    device = PROJECTOR if found.moved == PROJECTOR else f"camera {found.moved}"
    lines = [f"  orientation       of {device}, off by, which moves the points by {found.moves_mm:.3f} mm:"]
    for name, value, s in zip(found.names, np.degrees(found.change_rad), sigma, strict=True):
        lines.append(f"                    {name:<24}{value:+9.4f} +- {s:.4f} deg")
    return lines


def _map(rows: tuple[MeasurementRows, ...]) -> list[str]:
    """Return medians of the row errors in parts of the image, of the measurements organised alike."""
    known = [item for item in rows if item.mean_px is not None]
    pixels = np.concatenate([item.own_px for item in known])
    errors = np.concatenate([item.error_px for item in known])
    low, high = pixels.min(0), pixels.max(0) + 1
    cells = ((pixels - low) / (high - low) * PARTS).astype(int)
    lines = []
    for row in range(PARTS[1]):
        parts = [errors[(cells == (column, row)).all(1)] for column in range(PARTS[0])]
        text = "".join(f"{np.median(part):+8.2f}" if len(part) else f"{'-':>8}" for part in parts)
        lines.append(f"  {'over the image' if row == 0 else '':<16}  {text}{' px' if row == 0 else ''}")
    return lines


def write_adjusted(adjustment: Adjustment | None, check: RigCheck, path: Path) -> list[str]:
    """Write the adjusted rig where there is one; return what to tell."""
    if adjustment is None:
        return ["", f"Not adjusted, {path} not written: no row errors are observable."]
    if adjustment.refusal:
        return ["", f"Not adjusted, {path} not written: {adjustment.refusal}; calibrate again."]
    adjustment.rig.save(path)
    if adjustment.size_rad == 0 and not adjustment.change_rad.any():
        return ["", f"Nothing to adjust: noise explains the row errors; {path} is the rig as it was."]
    assert check.orientation is not None
    lines = ["", f"Adjusted orientation of {check.orientation.moved} against {check.orientation.fixed}, in {path}:"]
    for name, value, sigma, told in zip(
        check.orientation.names, np.degrees(adjustment.change_rad), np.degrees(adjustment.sigma_rad), adjustment.told,
        strict=True,
    ):  # fmt: skip
        said = "" if told > 0.5 else "  (hardly seen by row errors)"
        lines.append(f"  {name:<24}{value:+9.4f} +- {sigma:.4f} deg{said}")
    lines.append(f"  row error left: {adjustment.left_px:.3f} +- {adjustment.left_sigma_px:.3f} px, rms over the image")
    lines.append("  the points of the measurements are not moved by this: measure again with the new rig")
    lines.append(f"  (planish measure CAPTURE... --rig {path}), and check again")
    return lines


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="check-rig")(check_rig)
