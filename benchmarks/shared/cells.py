"""Long statistics in cells: one JSON file each, several processes, may be interrupted and taken up again."""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2

from planish.options import thread_count
from render_tables import RESULTS, ROOT, describe_machine

#: What a cell returns: rows of values for JSON.
Rows = list[dict[str, Any]]


def cell_arguments(description: str | None) -> argparse.ArgumentParser:
    """Return the parser with what all statistics have in common."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=thread_count())
    parser.add_argument("--again", action="store_true", help="compute the cells that are already there, too")
    parser.add_argument("--tables", action="store_true", help="make the tables of the cells that are there, only")
    return parser


def run_cells(
    folder: str, cells: Mapping[str, tuple[Any, ...]], function: Callable[..., Rows], workers: int, again: bool = False
) -> None:
    """Call function(*arguments) for each cell by name and save its rows; a cell that is already there is kept."""
    to_do = {name: values for name, values in cells.items() if again or not _path(folder, name).is_file()}
    os.environ["PLANISH_THREADS"] = "1"
    # Fresh processes: a copy of one that has run threads may wait for their locks for ever.
    fresh = get_context("spawn")
    with ProcessPoolExecutor(workers, fresh, cv2.setNumThreads, (1,)) as pool:
        futures = [pool.submit(_run_cell, _path(folder, name), function, values) for name, values in to_do.items()]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                print(f"{done} of {len(futures)}: {future.result()}", flush=True)
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            raise


def _run_cell(path: Path, function: Callable[..., Rows], values: tuple[Any, ...]) -> str:
    started = time.process_time()
    rows = function(*values)
    seconds = round(time.process_time() - started, 1)
    # ru_maxrss counts kilobytes on Linux.
    memory = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.part")
    head = {"machine": describe_machine(), "commit": commit(), "cpu_s": seconds, "peak_mib": memory}
    lines = ",\n  ".join(json.dumps(row, allow_nan=False) for row in rows)
    temporary.write_text(json.dumps(head)[:-1] + f',\n "rows": [\n  {lines}\n ]}}\n', encoding="utf-8")
    os.replace(temporary, path)
    return f"{path.stem}, {len(rows)} rows, {seconds} s of CPU, {memory} MiB"


def commit() -> str | None:
    """Return what of the history a cell was computed by, so that cells of different states can be told apart."""
    asked = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None


def read_cells(folder: str) -> Iterator[dict[str, Any]]:
    """Yield the contents of all cells of a folder that are there, by name."""
    for path in sorted((RESULTS / folder).glob("*.json")):
        yield {"cell": path.stem, **json.loads(path.read_text(encoding="utf-8"))}


def read_rows(folder: str) -> Rows:
    """Return the rows of all cells that are there."""
    return [row for cell in read_cells(folder) for row in cell["rows"]]


def machines(folder: str, cells: str = "*") -> str:
    """Return where the cells of a folder were computed, in words; `cells` is a pattern of their names."""
    read = (json.loads(path.read_text(encoding="utf-8")) for path in (RESULTS / folder).glob(f"{cells}.json"))
    return "; ".join(sorted({cell["machine"] for cell in read}))


def _path(folder: str, name: str) -> Path:
    return RESULTS / folder / f"{name}.json"
