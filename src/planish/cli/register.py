"""`planish register`: measurements to one registered part, with report and cloud."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from planish import storage
from planish.cli import console
from planish.cli.evaluate import print_overlap_table
from planish.errors import InputError
from planish.execution.cluster import DaskCluster
from planish.execution.executor import Executor, Threads
from planish.execution.pool import WorkerPool
from planish.files.cloud import write_registered
from planish.files.given import GivenFiles
from planish.pipeline import FileRun, RegisterOptions, add_files, register_files
from planish.pipeline.reporting import prepared_files, report_files
from planish.registration.result import Registration
from planish.report.network import network_lines

RUN_SCHEMA = "planish.run/1"
#: Exit code where --require-all finds a measurement that was not tied in.
NOT_TIED_IN = 3


def register(
    measurements: Annotated[
        list[Path] | None, typer.Argument(metavar="MEASUREMENT...", help="Files of `measure`, or folders of them.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for registration.json, registered.ply, report.html, figures.")
    ] = None,
    add: Annotated[
        list[Path] | None, typer.Option(help="A measurement, or a folder of them, to add to a registration; repeated.")
    ] = None,
    to: Annotated[Path | None, typer.Option(help="Folder of the registration to which --add adds.")] = None,
    reference: Annotated[str | None, typer.Option(help="Measurement whose frame becomes the world.")] = None,
    require_all: Annotated[bool, typer.Option(help="Exit with 3 if a measurement could not be tied in.")] = False,
    report: Annotated[bool, typer.Option(help="Write report.html and the figures.")] = True,
    cloud: Annotated[bool, typer.Option(help="Write registered.ply.")] = True,
    cloud_step: Annotated[int, typer.Option(help="Every n-th pixel along both axes goes to the cloud.")] = 1,
    options_file: Annotated[
        Path | None, typer.Option("--options", help="JSON file of options that differ from the defaults.")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
    workers: Annotated[
        int | None, typer.Option(help="Worker processes that share the threads; the bytes do not depend on it.")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(help="Dask scheduler, tcp://host:port, whose workers see the same folders.")
    ] = None,
    known_points: Annotated[
        Path | None, typer.Option(help="CSV file of targets: global coordinates, and those that measurements see.")
    ] = None,
    prior: Annotated[Path | None, typer.Option(help="JSON file of a robot's approximate transforms.")] = None,
    fixed: Annotated[Path | None, typer.Option(help="Mesh or cloud of the part whose frame becomes the world.")] = None,
) -> None:
    """Register MEASUREMENTs by their texture: no start value, no order, no neighbours needed.

    What has been computed lies in OUT/stages: the same command goes on where it was interrupted, and --add NEW --to DIR
    computes only what is new.
    """
    folder = _folder(measurements, out, add, to, options_file)
    options = RegisterOptions()
    if options_file is not None:
        options = RegisterOptions.parse(storage.read_json(options_file), str(options_file))
    given = GivenFiles(known_points, prior, fixed)
    with make_executor(threads, workers, cluster) as executor:
        paths = find_measurements(measurements or add or [])
        run = run_files(paths, folder, executor, options=options, add=bool(add), reference=reference, given=given)
        write_outputs(run, folder, executor, report, cloud, cloud_step)
    print_overlap_table(run.registration)
    loose = print_groups(run.registration)
    if require_all and loose:
        raise typer.Exit(NOT_TIED_IN)


def _folder(
    measurements: Sequence[Path] | None,
    out: Path | None,
    add: Sequence[Path] | None,
    to: Path | None,
    options_file: Path | None,
) -> Path:
    """Return the output folder of one of the two forms of the command."""
    if add or to is not None:
        if measurements or out is not None or not add or to is None:
            raise InputError("register", "--add and --to with something missing or too much", "--add NEW.h5 --to DIR")
        if options_file is not None:
            raise InputError("--options", f"{options_file} together with --add", "the options of the first run hold")
        return to
    if not measurements or out is None:
        missing = "--out" if measurements else "MEASUREMENT"
        raise InputError("register", f"{missing} is missing", "MEASUREMENT... --out DIR, or --add NEW.h5 --to DIR")
    return out


def make_executor(threads: int | None, workers: int | None, cluster: str | None) -> Executor:
    """Return what the options ask for: threads of this process, worker processes, or a cluster."""
    if cluster is not None:
        if workers is not None:
            raise InputError("--workers", "found together with --cluster", "one of them: a cluster has its own workers")
        return DaskCluster(cluster)
    return Threads(threads) if workers is None else WorkerPool(workers, threads)


def run_files(
    paths: Sequence[Path],
    out: Path,
    executor: Executor,
    *,
    options: RegisterOptions | None = None,
    add: bool = False,
    reference: str | None = None,
    given: GivenFiles | None = None,
) -> FileRun:
    """Register files, or add them, and write registration.json and run.json, so that nothing later can lose them."""
    started = time.time()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks: dict[str, TaskID] = {}

        def say(stage: str, done: int, total: int, reused: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=None)
            words = f"{stage} ({reused} there already)" if reused else stage
            bar.update(tasks[stage], description=words, completed=done, total=total)

        if add:
            run = add_files(paths, out, reference=reference, given=given, executor=executor, progress=say)
        else:
            run = register_files(
                paths, out, options, reference=reference, given=given, executor=executor, progress=say
            )  # fmt: skip
    reused = [f"{count} of {total} {_WHAT[stage]}" for stage, (count, total) in run.reused.items() if count]
    if reused:
        console.print(f"not computed again: {', '.join(reused)}", highlight=False)
    storage.write_json(
        out / "run.json",
        {
            "schema": RUN_SCHEMA,
            "measurements": {name: str(view.source.path) for name, view in run.views.items()},
            "time": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(started)),
            "seconds": round(time.time() - started, 3),
            "slots": executor.slots,
            "machine": platform.platform(),
            "command": sys.argv,
        },
    )
    return run


#: Results of the stages in plain words.
_WHAT = {"pattern": "sums for the sensor's pattern", "texture": "textures", "pairs": "pairs"}


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
    run: FileRun, out: Path, executor: Executor, report: bool = True, cloud: bool = True, step: int = 1
) -> None:
    """Write registered.ply, report.html and the figures."""
    if cloud:
        with console.status("writing registered.ply"):
            write_registered(out, run.registration, prepared_files(run), step)
    if report:
        with console.status("writing report.html"):
            report_files(run, out, executor)
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


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(register)
