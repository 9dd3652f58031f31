"""`planish evaluate DIR`: the table of the starting paper, and the errors against truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from planish import storage
from planish.cli import console
from planish.errors import InputError
from planish.evaluation import table
from planish.evaluation.overlap import DEFINITION, evaluate_overlap
from planish.evaluation.prepared import Prepared
from planish.evaluation.result import Evaluation, MeasurementError, PairError
from planish.evaluation.truth import Truth, compare_with_truth
from planish.execution.recent import Recent, main_process_bytes
from planish.measurement import Measurement
from planish.registration.result import PairResult, PlacedMeasurement, Registration

#: Width for output that does not go to a terminal: the tables must not be cut.
PIPE_WIDTH = 140


def register_command(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(name="evaluate")(evaluate)


def evaluate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of `planish register`.")],
    truth: Annotated[Path | None, typer.Option(help="True transforms (truth.json of a simulation).")] = None,
    measurements: Annotated[
        Path | None, typer.Option(help="Folder of the measurement files, if they have moved since.")
    ] = None,
) -> None:
    """Print how well registered measurements agree, write evaluation.json; with truth also the errors."""
    registration = Registration.load(folder / "registration.json")
    true_places = None if truth is None else Truth.load(truth)
    if true_places is not None:
        true_places.require([m.name for m in registration.measurements], str(truth))
    with console.status("reading measurements"):
        prepared = find_measurements(folder, registration, measurements)
    with console.status("comparing"):
        registration = replace(registration, pairs=tuple(_with_overlap(p, prepared) for p in registration.pairs))
        evaluation = (
            estimated(registration) if true_places is None else compare_with_truth(registration, true_places, prepared)
        )
    print_overlap_table(registration)
    if true_places is not None:
        print_truth_tables(evaluation)
    evaluation.save(folder / "evaluation.json")
    console.print(f"wrote {folder / 'evaluation.json'}", highlight=False)


class MeasurementFiles(Mapping[str, Prepared]):
    """The measurements of a registration by name, each read when it is asked for, and kept for a while."""

    def __init__(self, paths: Mapping[str, Path]) -> None:
        self._paths, self._recent = paths, Recent(main_process_bytes())

    def __getitem__(self, name: str) -> Prepared:
        return self._recent.get(name, lambda: Prepared(Measurement.load(self._paths[name])))

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)


def find_measurements(folder: Path, registration: Registration, moved_to: Path | None = None) -> MeasurementFiles:
    """Return the measurements of a registration by name, which lie where `run.json` (or `moved_to`) says.

    Raises
    ------
    InputError
        Where a file is missing or is not the one that was registered.
    """
    if moved_to is None:
        run = folder / "run.json"
        paths = storage.read_json(run).get("measurements", {})
        for item in registration.measurements:
            if not isinstance(paths, dict) or not isinstance(paths.get(item.name), str):
                raise InputError(run, f"names no file for the measurement '{item.name}'", "the run.json of this folder")
    else:
        paths = {item.name: str(moved_to / item.file) for item in registration.measurements}
    return MeasurementFiles({item.name: _checked(item, Path(paths[item.name])) for item in registration.measurements})


def _checked(item: PlacedMeasurement, path: Path) -> Path:
    if not path.is_file():
        raise InputError(path, "no such file", f"the measurement '{item.name}'; if it has moved: --measurements DIR")
    found = storage.sha256(path)
    if found != item.sha256:
        raise InputError(
            path, f"has changed since it was registered (SHA-256 {found[:12]}...)", f"{item.sha256[:12]}..."
        )
    return path


def _with_overlap(pair: PairResult, prepared: Mapping[str, Prepared]) -> PairResult:
    """Fill in what an accepted pair does not say about its overlap."""
    if pair.status != "accepted" or pair.T_a_b is None or pair.overlap_error is not None:
        return pair
    found = evaluate_overlap(prepared[pair.a], prepared[pair.b], pair.T_a_b)
    return replace(pair, overlap=found.overlap, overlap_error=found.error)


def estimated(registration: Registration) -> Evaluation:
    """Return the evaluation without truth: the estimated overlaps, and no errors."""
    pairs = tuple(PairError(p.a, p.b, p.overlap) for p in registration.pairs if p.status == "accepted")
    return Evaluation(pairs, tuple(MeasurementError(m.name) for m in registration.measurements))


def print_overlap_table(registration: Registration) -> None:
    """Print the paper's table with its definition, and the pairs that were not accepted with their reasons."""
    output = stdout()
    rows = table.pair_rows(registration)
    if rows:
        output.print(_table("Overlap error", table.PAIR_COLUMNS, rows))
        for line in DEFINITION:
            output.print(f"  {line}", style="dim", highlight=False)
    else:
        output.print("no pair was accepted")
    others = [(f"{p.a}, {p.b}", p.status, p.reason) for p in registration.pairs if p.status != "accepted"]
    if others:
        output.print(_table("Not accepted", (("pair", ""), ("status", ""), ("reason", "")), others, right=False))


def print_truth_tables(evaluation: Evaluation) -> None:
    """Print the errors against truth and what is wrong or missing."""
    output = stdout()
    output.print(_table("Pairs against truth", table.TRUTH_PAIR_COLUMNS, table.truth_pair_rows(evaluation)))
    rows = table.truth_measurement_rows(evaluation)
    output.print(_table("Measurements against truth", table.TRUTH_MEASUREMENT_COLUMNS, rows))
    output.print(
        "  along, normal: rms of (T_hat - T_true) x over the true overlap (pairs), over all own points (measurements). "
        "NEES / 6: squared error over stated covariance per degree of freedom, 1 on average where it is honest.",
        style="dim", highlight=False,
    )  # fmt: skip
    for finding in evaluation.findings:
        style = "bold red" if finding.startswith("WRONG") else "yellow"
        output.print(finding, style=style, highlight=False, markup=False)
    if not evaluation.findings:
        output.print("nothing wrong, nothing missing", style="green")


def stdout() -> Console:
    """Return a console on stdout that does not cut tables where there is no terminal."""
    plain = Console()
    return plain if plain.is_terminal else Console(width=PIPE_WIDTH)


def _table(
    title: str, columns: Sequence[tuple[str, str]], rows: Sequence[tuple[str, ...]], right: bool = True
) -> Table:
    out = Table(title=title, title_justify="left")
    for index, (name, unit) in enumerate(columns):
        # Text, not strings: brackets in names and reasons are no markup.
        out.add_column(Text(f"{name} [{unit}]" if unit else name), justify="right" if right and index else "left")
    for row in rows:
        out.add_row(*(Text(cell) for cell in row))
    return out
