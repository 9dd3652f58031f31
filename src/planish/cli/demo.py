"""`planish demo`: five simulated measurements of a car door, the whole chain, against truth and beside the paper."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from planish.cli import console
from planish.cli.evaluate import print_overlap_table, print_truth_tables, stdout
from planish.cli.measure import find_captures, summary
from planish.cli.register import find_measurements, print_groups, run_files
from planish.evaluation.truth import Truth, compare_with_truth
from planish.execution.executor import Threads
from planish.files.cloud import write_registered
from planish.options import thread_count
from planish.pipeline import measure
from planish.pipeline.reporting import prepared_files, report_files
from planish.registration.result import Registration
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene

#: Result table of von Enzberg et al., Sensors 2016, 16(3), 283: pair, matches, consensus, min, max, "MSE" [mm].
PAPER_TABLE = (
    ("1, 2", 344, 82, -0.457, 0.333, 0.105),
    ("2, 3", 194, 23, -0.549, 0.701, 0.096),
    ("3, 4", 152, 26, -0.599, 0.417, 0.139),
    ("4, 5", 234, 25, -0.451, 0.457, 0.142),
)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for captures, measurements and the registered part.")],
    seed: Annotated[int, typer.Option(help="Everything random follows from it.")] = 1,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
) -> None:
    """Simulate five captures of a car door, measure, register, evaluate and report them."""
    started = time.perf_counter()
    count = thread_count(threads)
    captures, measured = out / "captures", out / "measurements"
    with console.status("") as status:
        scene = make_scene("door", seed)
        write_scene(scene, captures, true_points=False, threads=count,
                    progress=lambda name: status.update(f"simulating {name}"))  # fmt: skip
        for capture in find_captures([captures], None):
            status.update(f"measuring {capture.name}")
            measurement = measure(capture, threads=count)
            measurement.save(measured / f"{measurement.name}.h5")
            typer.echo(summary(measurement))
    with Threads(threads) as executor:
        run = run_files(find_measurements([measured]), out, executor)
        with console.status("evaluating, writing cloud and report"):
            prepared = prepared_files(run, count)
            evaluation = compare_with_truth(run.registration, Truth.load(captures / "truth.json"), prepared)
            evaluation.save(out / "evaluation.json")
            write_registered(out, run.registration, prepared)
            report = report_files(run, out, executor, evaluation)
    print_overlap_table(run.registration)
    print_beside_paper(run.registration)
    print_truth_tables(evaluation)
    print_groups(run.registration)
    console.print(f"{time.perf_counter() - started:.0f} s; open {report}", highlight=False)


def print_beside_paper(registration: Registration) -> None:
    """Print the starting paper's table beside ours: another part, so that only the order of magnitude compares."""
    pairs = {(p.a, p.b): p for p in registration.pairs}
    names = [m.name for m in registration.measurements]
    table = Table(title="Consecutive pairs: starting paper (its part) | planish (simulated door)", title_justify="left")
    for column in ("pair", "matches", "consensus", "min [mm]", "max [mm]", "error [mm]"):
        table.add_column(column, justify="right")
    for row, (a, b) in zip(PAPER_TABLE, pairwise(names), strict=False):
        ours = pairs[a, b]
        e = ours.overlap_error
        mine = (ours.matches, ours.consensus, e.min_mm, e.max_mm, e.rms_normal_mm) if e else ("-",) * 5
        cells = [
            f"{theirs} | {value}"
            if isinstance(theirs, int)
            else f"{theirs:.3f} | {value:.3f}"
            if e
            else f"{theirs:.3f} | -"
            for theirs, value in zip(row[1:], mine, strict=True)
        ]
        table.add_row(row[0], *cells)
    output = stdout()
    output.print(table)
    output.print(
        '  error: the paper\'s "MSE" is printed in mm and not defined; ours is the rms along the normal. The paper\'s '
        "min and max are not defined either; ours are medians over cells of 2 mm.",
        style="dim", highlight=False,
    )  # fmt: skip


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(demo)
