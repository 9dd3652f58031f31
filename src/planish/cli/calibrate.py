"""`planish calibrate`: images of a board to a calibrated rig with its covariance, and a report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from planish import storage
from planish.cli import console
from planish.cli.evaluate import stdout
from planish.errors import InputError
from planish.pipeline import CalibrateOptions, versions
from planish.pipeline import calibrate as calibrate_boards
from planish.rig import Rig
from planish.sensing.calibrate.files import CalibrationFile
from planish.sensing.calibrate.judge.advice import advice, device_title
from planish.sensing.calibrate.judge.expected_error import ExpectedError, expected_errors
from planish.sensing.calibrate.result import Calibration

#: The lens model that the boards support is chosen by cross-validation.
AUTO = "auto"


def calibrate(
    boards: Annotated[Path, typer.Argument(metavar="BOARDS", help="Folder or manifest of images of a board.")],
    out: Annotated[Path, typer.Option(help="File for the rig, for example rig.json; report and figures beside it.")],
    board: Annotated[Path | None, typer.Option(help="Board file, where the manifest names none.")] = None,
    images: Annotated[Path | None, typer.Option(help="Folder the image names are relative to.")] = None,
    model: Annotated[
        str,
        typer.Option(help="Lens model of all devices; auto: what the boards support."),
    ] = AUTO,
    flatness: Annotated[bool, typer.Option("--flatness", help="Estimate the board's height map, too.")] = False,
    keep_frame: Annotated[
        Path | None, typer.Option(help="Earlier rig.json: its sensor frame is kept; default: the frame of camera A.")
    ] = None,
    report: Annotated[bool, typer.Option(help="Write the report and its figures.")] = True,
    options_file: Annotated[
        Path | None, typer.Option("--options", help="JSON file of options that differ from the defaults.")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
) -> None:
    """Calibrate cameras and projector with the images of a board: a rig with the covariance of its parameters."""
    if out.suffix != ".json":
        raise InputError("--out", f"found '{out}'", "the name of a file that ends in .json")
    options = read_options(options_file, model, flatness)
    earlier = None if keep_frame is None else Rig.load(keep_frame)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("boards", total=None)
        result = calibrate_boards(
            boards, options, board=board, images_dir=images, threads=threads,
            progress=lambda stage, done, total: bar.update(task, description=stage, completed=done, total=total),
        )  # fmt: skip
    errors = expected_errors(result)
    # The report tells of everything in the frame of camera A; only the rig that is used elsewhere changes its frame.
    rig = result.rig if earlier is None else result.rig.in_sensor_frame_of(earlier)
    written = write_calibration(result, rig, errors, out, report)
    print_calibration(result, errors)
    console.print(f"wrote {', '.join(str(path) for path in written)}", highlight=False, soft_wrap=True)


def read_options(file: Path | None, model: str, flatness: bool) -> CalibrateOptions:
    """Return the options of the file, and over them those of the command line."""
    values = {} if file is None else storage.read_json(file)
    if model != AUTO:
        values["model"] = model
    if flatness:
        values["flatness"] = True
    return CalibrateOptions.parse(values, "calibrate" if file is None else str(file))


def write_calibration(
    calibration: Calibration, rig: Rig, errors: Sequence[ExpectedError], out: Path, report: bool = True
) -> list[Path]:
    """Write the rig in the frame that is wanted, what it rests on, and the report; return the files' paths."""
    rig.save(out)
    record = out.with_name(f"{out.stem}_calibration.json")
    CalibrationFile.of(calibration, versions(), errors).save(record)
    if not report:
        return [out, record]
    # Here, not above: what draws takes a while to be imported.
    from planish.report.calibration.page import write_calibration_report

    with console.status("writing the report"):
        page = write_calibration_report(calibration, out.with_name(f"{out.stem}_report.html"), versions())
    return [out, record, page]


def print_calibration(calibration: Calibration, errors: Sequence[ExpectedError]) -> None:
    """Print one line per device, the expected error, on what the scale rests, warnings and advice."""
    from planish.report.calibration.text import error_sentence, scale_sentence

    output = stdout()
    output.print(device_table(calibration))
    sentences = [error_sentence(calibration, error) for error in errors]
    for sentence in [*sentences, *([scale_sentence(calibration)] if sentences else [])]:
        output.print(sentence, highlight=False, markup=False, soft_wrap=True)
    for sentence in advice(calibration, errors):
        output.print(Text.assemble(("advice: ", "bold"), sentence), soft_wrap=True)
    missed = calibration.observations.missed
    if missed:
        output.print(f"{len(missed)} images were not used:", highlight=False)
        for image, reason in missed.items():
            output.print(f"  {image}: {reason}", highlight=False, markup=False, soft_wrap=True)
    for finding in calibration.findings:
        if finding.warning:
            console.print("warning:", style="bold yellow", end=" ")
            console.print(finding.warning, highlight=False, markup=False, soft_wrap=True)


def device_table(calibration: Calibration) -> Table:
    """Return the table of the devices: model, views, points, residuals."""
    from planish.report.calibration.numbers import pixels

    record = CalibrationFile.of(calibration, errors=())
    table = Table(title="Calibration", title_justify="left")
    titles = ("device", "lens model", "views", "points", "outliers", "rms [px]", "left out [px]", "sigma [px]")
    for index, title in enumerate(titles):
        table.add_column(Text(title), justify="left" if index < 2 else "right")
    for name, entry in record.devices.items():
        cells = (
            device_title(name),
            entry.model.name if entry.model else "",
            str(entry.views),
            f"{entry.points:,}",
            str(entry.outliers),
            pixels(entry.rms_px),
            pixels(entry.left_out_rms_px),
            pixels(entry.noise_px),
        )
        table.add_row(*(Text(cell) for cell in cells))
    return table


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(calibrate)
