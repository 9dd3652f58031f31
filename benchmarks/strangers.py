"""Pairs that share nothing: captures of different parts with the same grain statistics, and of one part far apart.

    python benchmarks/strangers.py --parts 150                (all pairs of 150 captures: 11,175)
    python benchmarks/strangers.py --tables

All captures come from one sensor. Nothing may be accepted. For every pair the number of false alarms is kept before the
correction for the number of pairs of the run: where nothing overlaps, its logarithm may fall below -k in no more than
10^-k of the pairs.
"""

from __future__ import annotations

import pickle
import tempfile
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import combinations, product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.stats import beta

from coarse_pairs.parts import HALF_SAMPLES, SURFACES, Seen, Stand, seen_overlap
from coarse_pairs.tables import cases as coarse_cases
from planish.pipeline import RegisterOptions, prepare_run
from planish.registration.pair import register_pair
from planish.registration.prepared import Prepared, RefinementMaps, Sides
from planish.simulation.scenes import Scene, make_scene
from render_tables import save_table
from shared.cells import Rows, cell_arguments, commit, machines, read_rows, run_cells
from shared.rendered import measure_scene

FOLDER = "strangers"
#: Captures that are prepared as one run, and registered against another such block in one cell.
BLOCK = 10
#: All captures are taken by this sensor; the parts differ by their numbers.
SENSOR, FIRST_PART = 9000, 20000
#: Parts of which two captures on one side are tried against two on the other, and how far they are from the middle.
FAR_PARTS, FIRST_FAR, FAR_MM = 12, 30000, 330.0
#: The most that two captures of a part may overlap by the plan, rays being 15 mm apart, to share nothing.
NO_OVERLAP = 0.0
#: Levels -k at which the fraction is held against 10^-k, and the confidence of its interval.
LEVELS, CONFIDENCE = (0, 1, 2, 3), 0.95


def stranger_scene(number: int, stands: tuple[Stand, ...]) -> Scene:
    """Return a part of the default texture at half resolution, seen by the one sensor."""
    scene = make_scene(SURFACES[number % len(SURFACES)], number, 1, scale=0.5)
    sensor = replace(scene.sensor, seed=SENSOR, samples_per_px=HALF_SAMPLES)
    places = [stand.place(scene.surface) for stand in stands]
    return replace(scene.seen_from([T for T in places if T is not None]), sensor=sensor)


def _any_stand(rng: np.random.Generator, s: float = 0.0, t: float = 0.0) -> Stand:
    at, tilt = rng.uniform(-60, 60, 2) + (s, t), rng.uniform(-10, 10, 2)
    return Stand(
        s=float(at[0]),
        t=float(at[1]),
        roll_deg=rng.uniform(0, 360),
        tilt_deg=(float(tilt[0]), float(tilt[1])),
        closer_mm=rng.uniform(-40, 40),
    )


class StoredMaps(RefinementMaps):
    """Refinement maps that are read from their file when asked for: pairs that are refused never ask."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def get(self) -> tuple[Sides, Sides]:
        """Return the maps, read anew."""
        return pickle.loads(self.path.read_bytes())

    def begin(self) -> None:
        """Do nothing: they have been made."""


def _store(item: Any, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Another process may be at the same file: whoever comes last replaces it by the same.
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        pickle.dump(item, file, protocol=5)
    return Path(file.name).replace(path)


def _slim(item: Prepared, scratch: Path) -> Prepared:
    return replace(
        item, refinement=StoredMaps(_store(item.refinement.get(), scratch / f"{item.measurement.name}.maps"))
    )


def of_this_state(scratch: Path) -> Path:
    """Return the folder for what the code as it stands prepares: that of another state may be of other classes."""
    state = commit()
    if state is None or state.endswith("dirty"):
        scratch.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(dir=scratch))
    return scratch / state


def prepare_block(block: int, parts: int, scratch: Path) -> tuple[RegisterOptions, list[Prepared]]:
    """Return the captures of a block, prepared as one run; kept in the scratch folder for the other cells."""
    path = scratch / f"block_{block:03d}.pickle"
    if path.is_file():
        return pickle.loads(path.read_bytes())
    numbers = range(block * BLOCK, min(parts, (block + 1) * BLOCK))
    measured = []
    for number in numbers:
        rng = np.random.default_rng([number, 21])
        measured.append(measure_scene(stranger_scene(FIRST_PART + number, (_any_stand(rng),)), 0, f"part{number}"))
    options, prepared = prepare_run(measured, threads=1)
    found = options, [_slim(p, scratch) for p in prepared.values()]
    _store(found, path)
    return found


def run_blocks(first: int, second: int, parts: int, scratch: Path) -> Rows:
    """Return one row: what comes of all pairs of captures of two blocks (or within one)."""
    options, a = prepare_block(first, parts, scratch)
    b = a if first == second else prepare_block(second, parts, scratch)[1]
    pairs = combinations(a, 2) if first == second else product(a, b)
    return [_row("parts", (_try(x, y, options) for x, y in pairs))]


def run_far(number: int) -> Rows:
    """Return one row: what comes of the pairs of one part's captures that share nothing."""
    rng = np.random.default_rng([number, 22])
    scene = stranger_scene(FIRST_FAR + number, ())
    reach = min(FAR_MM, scene.surface.half_s - 110.0)
    stands = tuple(_any_stand(rng, side * reach) for side in (-1, -1, 1, 1))
    scene = stranger_scene(FIRST_FAR + number, stands)
    seen = [Seen.of(scene.surface, scene.rig, T) for T in scene.T_object_sensor]
    measured = [measure_scene(scene, k) for k in range(len(stands))]
    options, prepared = prepare_run(measured, threads=1)
    apart = [(i, j) for i, j in combinations(range(len(stands)), 2) if seen_overlap(seen[i], seen[j]) <= NO_OVERLAP]
    names = [m.name for m in measured]
    return [_row("far", (_try(prepared[names[i]], prepared[names[j]], options) for i, j in apart))]


def _try(a: Prepared, b: Prepared, options: RegisterOptions) -> dict[str, Any]:
    result = register_pair(a, b, options, 1, 1)
    return {
        "names": [a.measurement.name, b.measurement.name],
        "status": result.status,
        "reason": result.reason,
        "places": result.consensus,
        "alarms": round(result.log10_false_alarms, 3),
    }


def _row(kind: str, tried: Any) -> dict[str, Any]:
    found = list(tried)
    return {
        "kind": kind,
        "log10_false_alarms": [item["alarms"] for item in found],
        "statuses": dict(Counter(item["status"] for item in found)),
        # Only what is not refused is of interest one by one.
        "not_refused": [item for item in found if item["status"] != "refused"],
    }


def save_tables() -> None:
    """Save the tables `strangers` and `false-alarms`."""
    rows = read_rows(FOLDER)
    table = []
    for kind, heading in (("parts", "different parts"), ("far", "one part, no overlap")):
        of_it = [r for r in rows if r["kind"] == kind]
        if of_it:
            alarms = [a for r in of_it for a in r["log10_false_alarms"]]
            statuses = sum((Counter(r["statuses"]) for r in of_it), Counter())
            row = {"what": heading, "pairs": len(alarms), "lowest": min(alarms)}
            table.append(row | {status: statuses[status] for status in ("accepted", "ambiguous", "refused")})
            for r in of_it:
                for item in r["not_refused"]:
                    print(item)
    if not table:
        return
    columns = {
        "what": "pairs without overlap", "pairs": "number", "accepted": "accepted", "ambiguous": "ambiguous",
        "refused": "refused", "lowest": "lowest log10 false alarms",
    }  # fmt: skip
    save_table(
        "strangers", columns, table, "python benchmarks/strangers.py", {"lowest": ".1f"}, machine=machines(FOLDER)
    )
    print(*table, sep="\n")
    _save_honesty([a for r in rows for a in r["log10_false_alarms"]])


def _save_honesty(alarms: list[float]) -> None:
    """Save how often chance reaches a level, against what the level promises; and what true pairs reach."""
    table: Rows = []
    for k in LEVELS:
        count, n = sum(a <= -k for a in alarms), len(alarms)
        # Clopper and Pearson 1934: exact limits of a binomial share.
        tail = (1 - CONFIDENCE) / 2
        low = float(beta.ppf(tail, count, n - count + 1)) if count else 0.0
        high = float(beta.ppf(1 - tail, count + 1, n - count)) if count < n else 1.0
        table.append({"what": f"no overlap: share at or below {-k}", "found": count / n, "low": low, "high": high,
                      "promised": 10.0**-k})  # fmt: skip
    true = [r["log10_false_alarms"] for r in coarse_cases() if r["overlap"] >= 0.3 and "log10_false_alarms" in r]
    if true:
        what = f"{len(true)} true pairs, overlap >= 30 %: median"
        table.append({"what": what, "found": median(true), "promised": -10.0})
    columns = {
        "what": "log10 false alarms of a pair", "found": "found", "low": f"{CONFIDENCE:.0%} limits, lower",
        "high": "upper", "promised": "at most",
    }  # fmt: skip
    formats = dict.fromkeys(("found", "low", "high", "promised"), ".3g")
    save_table("false-alarms", columns, table, "python benchmarks/strangers.py", formats, machine=machines(FOLDER))
    print(*table, sep="\n")


def main() -> None:
    parser = cell_arguments(__doc__)
    parser.add_argument("--parts", type=int, default=150)
    parser.add_argument("--far-parts", type=int, default=FAR_PARTS)
    parser.add_argument("--scratch", type=Path, default=Path(tempfile.gettempdir()) / "planish-strangers")
    arguments = parser.parse_args()
    if not arguments.tables:
        scratch = of_this_state(arguments.scratch)
        run = partial(run_cells, FOLDER, workers=arguments.workers, again=arguments.again)
        run({f"far_{n:02d}": (n,) for n in range(arguments.far_parts)}, run_far)
        blocks = -(-arguments.parts // BLOCK)
        # Each block with itself first: so no two processes prepare the same one.
        within = {f"parts_{k:02d}_{k:02d}": (k, k, arguments.parts, scratch) for k in range(blocks)}
        run(within, run_blocks)
        between = combinations(range(blocks), 2)
        run({f"parts_{i:02d}_{j:02d}": (i, j, arguments.parts, scratch) for i, j in between}, run_blocks)
    save_tables()


if __name__ == "__main__":
    main()
