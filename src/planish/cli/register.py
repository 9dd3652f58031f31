"""`planish register`: measurements to one registered part, with report and cloud."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from planish import storage
from planish.cli import console
from planish.cli.evaluate import print_overlap_table
from planish.errors import InputError
from planish.evaluation.prepared import Prepared
from planish.files.cloud import write_registered
from planish.files.given import GivenFiles, read_given
from planish.measurement import Measurement
from planish.options import thread_count
from planish.pipeline import RegisteredRun, RegisterOptions, register_run
from planish.registration.result import Registration
from planish.report import write_report
from planish.report.network import network_lines

RUN_SCHEMA = "planish.run/1"
#: Exit code where --require-all finds a measurement that was not tied in.
NOT_TIED_IN = 3


def register(
    measurements: Annotated[
        list[Path], typer.Argument(metavar="MEASUREMENT...", help="Files of `planish measure`, or folders of them.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for registration.json, registered.ply, report.html, figures.")],
    reference: Annotated[str | None, typer.Option(help="Measurement whose frame becomes the world.")] = None,
    require_all: Annotated[bool, typer.Option(help="Exit with 3 if a measurement could not be tied in.")] = False,
    report: Annotated[bool, typer.Option(help="Write report.html and the figures.")] = True,
    cloud: Annotated[bool, typer.Option(help="Write registered.ply.")] = True,
    cloud_step: Annotated[int, typer.Option(help="Every n-th pixel along both axes goes to the cloud.")] = 1,
    options_file: Annotated[
        Path | None, typer.Option("--options", help="JSON file of options that differ from the defaults.")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
    known_points: Annotated[
        Path | None, typer.Option(help="CSV file of targets: global coordinates, and those that measurements see.")
    ] = None,
    prior: Annotated[Path | None, typer.Option(help="JSON file of a robot's approximate transforms.")] = None,
    fixed: Annotated[Path | None, typer.Option(help="Mesh or cloud of the part whose frame becomes the world.")] = None,
) -> None:
    """Register MEASUREMENTs by their texture: no start value, no order, no neighbours needed."""
    run = register_files(
        measurements, out, reference, options_file, threads, GivenFiles(known_points, prior, fixed)
    )  # fmt: skip
    write_outputs(run, out, report, cloud, cloud_step, threads)
    print_overlap_table(run.registration)
    loose = print_groups(run.registration)
    if require_all and loose:
        raise typer.Exit(NOT_TIED_IN)


def register_files(
    paths: Sequence[Path],
    out: Path,
    reference: str | None,
    options_file: Path | None,
    threads: int | None,
    given: GivenFiles | None = None,
) -> RegisteredRun:
    """Read, register, and write registration.json and run.json, so that nothing later can lose them."""
    started = time.time()
    options = RegisterOptions()
    if options_file is not None:
        options = RegisterOptions.parse(storage.read_json(options_file), str(options_file))
    files = find_measurements(paths)
    loaded = [Measurement.load(path) for path in files]
    _require_unique([m.name for m in loaded], files)
    known = read_given(given or GivenFiles(), [m.name for m in loaded])
    hashes = {m.name: (path.name, storage.sha256(path)) for m, path in zip(loaded, files, strict=True)}
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks = {stage: bar.add_task(stage, total=None) for stage in ("texture", "pairs", "overlap")}
        run = register_run(
            loaded, options, reference=reference, files=hashes, given=known, threads=threads,
            progress=lambda stage, done, total: bar.update(tasks[stage], completed=done, total=total),
        )  # fmt: skip
    run.registration.save(out / "registration.json")
    if run.registration.joint is not None:
        run.registration.joint.save(out / "network.h5")
    storage.write_json(
        out / "run.json",
        {
            "schema": RUN_SCHEMA,
            "measurements": {m.name: str(path.resolve()) for m, path in zip(loaded, files, strict=True)},
            "time": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(started)),
            "seconds": round(time.time() - started, 3),
            "threads": thread_count(threads),
            "machine": platform.platform(),
            "command": sys.argv,
        },
    )
    return run


def find_measurements(paths: Sequence[Path]) -> list[Path]:
    """Return the measurement files that `paths` name; a folder stands for the .h5 files in it.

    Raises
    ------
    InputError
        Where a path does not exist or a folder holds no measurement.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.glob("*.h5") if not p.name.startswith("."))
            if not inside:
                raise InputError(path, "the folder holds no .h5 file", "measurements written by `planish measure`")
            files += inside
        elif path.is_file():
            files.append(path)
        else:
            raise InputError(path, "no such file or folder", "a measurement written by `planish measure`")
    return files


def write_outputs(
    run: RegisteredRun, out: Path, report: bool = True, cloud: bool = True, step: int = 1, threads: int | None = None
) -> None:
    """Write registered.ply, report.html and the figures."""
    registration = run.registration
    if cloud:
        with console.status("writing registered.ply"):
            measurements = {name: p.measurement for name, p in run.prepared.items()}
            surfaces = {name: p.surface for name, p in run.prepared.items()}
            write_registered(out, registration, measurements, surfaces, step)
    if report:
        with console.status("writing report.html"):
            prepared = {n: Prepared(p.measurement, p.surface, p.contrast) for n, p in run.prepared.items()}
            write_report(registration, prepared, list(run.overlaps.values()), out, threads=threads)
    console.print(f"wrote {out}", highlight=False)


def print_groups(registration: Registration) -> bool:
    """Say what is tied together; return whether anything is not tied to the largest group."""
    for group in registration.groups:
        names = [m.name for m in registration.measurements if m.group == group.id]
        what = "alone" if len(names) == 1 else f"{len(names)} measurements, reference {group.reference}"
        typer.echo(f"group {group.id}: {what}: {', '.join(names)}")
    for line in network_lines(registration.network):
        typer.echo(line)
    return len(registration.groups) > 1


def _require_unique(names: Sequence[str], files: Sequence[Path]) -> None:
    seen: dict[str, Path] = {}
    for name, path in zip(names, files, strict=True):
        if name in seen:
            raise InputError(path, f"holds the measurement '{name}' that {seen[name]} holds too", "different names")
        seen[name] = path


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(register)
