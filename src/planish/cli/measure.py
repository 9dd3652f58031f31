"""`planish measure`: fringe images to measurements, one HDF5 file per capture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from planish.cli import console
from planish.errors import InputError
from planish.execution.memory import kept_memory
from planish.execution.pool import WorkerPool
from planish.measurement import Finding, Measurement
from planish.options import thread_count
from planish.pipeline import MeasureOptions
from planish.pipeline import measure as measure_capture
from planish.pipeline.saving import save_each
from planish.sensing.capture.manifest import Capture

MANIFEST = "capture.json"
#: Findings that are always printed; the others stand in the file, and are printed on request.
MAIN_FINDINGS = ("movement in", "row error", "projector against", "coverage")


def find_captures(paths: list[Path], images_dir: Path | None) -> list[Capture]:
    """Return the captures that `paths` name: manifests, folders with one, or folders of such folders.

    Raises
    ------
    InputError
        Where a path leads to no manifest, or two captures have one name.
    """
    manifests: list[Path] = []
    for path in paths:
        if path.is_dir() and not (path / MANIFEST).is_file():
            inside = sorted(path.glob(f"*/{MANIFEST}"))
            if not inside:
                raise InputError(path, "no capture in this folder", f"a {MANIFEST} in it or in its subfolders")
            manifests += inside
        elif path.exists():
            manifests.append(path / MANIFEST if path.is_dir() else path)
        else:
            raise InputError(path, "no such file or folder", f"a {MANIFEST}, or a folder that holds one")
    captures = [Capture.load(path, images_dir) for path in manifests]
    seen: dict[str, Path] = {}
    for capture in captures:
        if capture.name in seen:
            raise InputError(
                capture.path,
                f"the name '{capture.name}' is also that of {seen[capture.name]}",
                "a different 'name' in each manifest (default: its folder's name)",
            )
        seen[capture.name] = capture.path
    return captures


def summary(measurement: Measurement) -> str:
    """Return one line: valid points, their share, median sigma."""
    valid = measurement.valid
    sigma = float(np.nanmedian(measurement.sigma_mm)) if valid.any() else float("nan")
    return (
        f"{measurement.name}: {int(valid.sum())} points, {100 * float(valid.mean()):.1f} % of the pixels, "
        f"median sigma {sigma:.4f} mm"
    )


@dataclass(frozen=True)
class Job:
    """A capture to be measured into a folder; `rig` are calibration files instead of its own."""

    capture: Capture
    options: MeasureOptions
    rig: tuple[Path, ...]
    out: Path
    why: bool


@dataclass(frozen=True)
class Measured:
    """What is said of a measurement that has been written; `shares` of pixels without a point, by reason."""

    name: str
    summary: str
    findings: tuple[Finding, ...]
    shares: dict[str, str]


def measure_job(job: Job, threads: int) -> Measured:
    """Measure a capture and write its measurement."""
    measurement, path, measured = _measure(job, threads)
    measurement.save(path)
    return measured


def _measure(job: Job, threads: int) -> tuple[Measurement, Path, Measured]:
    """Return a measurement, its file, which is not written yet, and what is said of it."""
    capture = job.capture
    rig = capture.load_rig(job.options.organise_on, list(job.rig) or None)
    measurement = measure_capture(capture, job.options, threads, rig)
    shares = _explain(measurement, job.out / f"{measurement.name}_why.png") if job.why else {}
    measured = Measured(measurement.name, summary(measurement), measurement.findings, shares)
    return measurement, job.out / f"{measurement.name}.h5", measured


def _explain(measurement: Measurement, path: Path) -> dict[str, str]:
    # Here, not above: what draws takes a while to be imported.
    from planish.report.why import rejection_shares, share_text, write_why

    write_why(path, measurement)
    return {name: share_text(share) for name, share in rejection_shares(measurement).items()}


def _say(done: Measured, all_findings: bool) -> None:
    """Print what the capture says about itself: findings as results, what the user should know as warnings."""
    typer.echo(done.summary)
    for finding in done.findings:
        if all_findings or finding.quantity.startswith(MAIN_FINDINGS):
            typer.echo(f"  {finding}")
        if finding.warning:
            console.print("warning:", style="bold yellow", end=" ")
            text = f"{done.name}: {finding.warning}"
            console.print(text, highlight=False, markup=False, soft_wrap=True)
    for name, share in done.shares.items():
        typer.echo(f"  {name:<16}{share:>9}")


def _measured(jobs: Sequence[Job], threads: int, workers: int | None) -> Iterator[Measured]:
    """Yield what has been measured, in the order of the jobs."""
    if workers is None:
        # One after the other: a capture's images fill the threads, and one capture at a time the memory.
        with kept_memory():
            yield from save_each(_measure(job, threads) for job in jobs)
        return
    waiting: dict[int, Measured] = {}
    said = 0
    with WorkerPool(workers, threads) as pool:
        for index, done in pool.map(measure_job, jobs):
            waiting[index] = done
            while said in waiting:
                yield waiting.pop(said)
                said += 1


def _views(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def measure(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="capture.json, or folders of them.")],
    out: Annotated[Path, typer.Option(help="Folder for the measurements, one <name>.h5 each.")],
    rig: Annotated[
        list[Path] | None,
        typer.Option(help="Calibration to use instead of the captures' own; repeated for OpenCV's in several files."),
    ] = None,
    images: Annotated[Path | None, typer.Option(help="Folder the image names are relative to.")] = None,
    organise_on: Annotated[str, typer.Option(help="Camera whose pixel grid organises the points: A or B.")] = "A",
    geometry: Annotated[
        str, typer.Option(help="Points from two cameras (stereo), camera and projector (projector), or both (auto).")
    ] = "auto",
    texture_views: Annotated[str, typer.Option(help="Cameras whose images serve as texture.")] = "A,B",
    why: Annotated[bool, typer.Option("--why", help="Also show why pixels have no point, in <name>_why.png.")] = False,
    findings: Annotated[
        bool, typer.Option("--findings", help="Print all that a capture says about itself, not the main points only.")
    ] = False,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
    workers: Annotated[
        int | None, typer.Option(help="Worker processes, each with a capture of its own, that share the threads.")
    ] = None,
) -> None:
    """Turn the fringe images of each CAPTURE into a textured 3D measurement."""
    values: dict[str, Any] = {"organise_on": organise_on, "geometry": geometry, "texture_views": _views(texture_views)}
    options = MeasureOptions.parse(values, "measure")
    count = thread_count(threads)
    jobs = [Job(capture, options, tuple(rig or ()), out, why) for capture in find_captures(captures, images)]
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("measuring", total=len(jobs))
        for measured in _measured(jobs, count, workers):
            _say(measured, findings)
            progress.advance(task)


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(measure)
