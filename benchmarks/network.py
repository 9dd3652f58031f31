"""The network: wrong pairs named, errors against covariances, growth; on drawn pairs and on rendered captures.

    python benchmarks/network.py                    # drawn pairs: blunders, honesty, growth, given inputs; minutes
    python benchmarks/network.py --rendered small   # captures, measured and registered: 3 x 2 panel, ring, reduced;
                                                    # two parts mixed, a stranger, wrong pairs, a robot that errs
    python benchmarks/network.py --rendered full    # 8 x 5 panel of 2.4 m x 1.2 m, ring of 16, full resolution
    python benchmarks/network.py --order            # how often measurements are prepared for their pairs; seconds
    python benchmarks/network.py --sizes 50 100     # growth of whole runs of files, of the sizes 50 100 200 400 1000

Whole runs (networks/grown.py) and rendered networks (networks/rendered.py) go in cells: those that are there are not
run again, and the table is made of all.

Drawn pairs have the covariances of a plate with 3 % grain and an overlap of a third (networks/drawn.py). Rendered
captures go from files through the whole registration.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from networks.drawn import Truth, draw_pairs, misplaced, panel, ring, shift, unused
from planish.geometry import invert
from planish.registration.network.build import build_network
from planish.registration.result import Registration
from render_tables import save_table

Row = dict[str, Any]

#: Columns and rows of a panel, wrong pairs, and how far they are off [mm].
CASES = ((8, 5, 3, 5.0), (8, 5, 3, 1.0), (8, 5, 10, 5.0), (8, 5, 20, 5.0), (4, 3, 3, 5.0))


def errors_mm(truth: Truth, result: Registration) -> list[float]:
    """Distances of all centroids from their true places in the frame of their group's reference [mm]."""
    out = []
    for group in result.groups:
        placed = [m for m in result.measurements if m.group == group.id]
        xi = misplaced(truth, placed, invert(truth.T[group.reference]))
        out += [float(np.linalg.norm(x[3:])) for x in xi.values()]
    return out


def nees(truth: Truth, result: Registration) -> list[float]:
    """NEES / 6 of all measurements but the reference."""
    reference = result.groups[0].reference
    xi = misplaced(truth, result.measurements, invert(truth.T[reference]))
    placed = [m for m in result.measurements if m.name != reference]
    return [float(xi[m.name] @ np.linalg.solve(m.covariance_noise, xi[m.name])) / 6 for m in placed]


def shapes(seed: int) -> Iterator[tuple[str, Truth]]:
    yield "panel, 8 x 5", panel(8, 5, seed)
    yield "ring of 16", ring(16)
    yield "chain of 20", panel(20, 1, seed)


def honesty(seeds: int) -> list[Row]:
    rows = []
    for kind in range(3):
        values, worst, closures, predicted, taken = [], [], [], [], 0
        for seed in range(seeds):
            name, truth = list(shapes(seed))[kind]
            result = build_network(truth.nodes(), draw_pairs(truth, seed))
            values += nees(truth, result)
            worst.append(max(errors_mm(truth, result)))
            closures += [loop.closure_mm**2 for loop in result.network.loops]
            predicted += [loop.predicted_mm**2 for loop in result.network.loops]
            taken += len(unused(result.pairs))
        rows.append(
            {
                "network": name, "networks": seeds, "nees": float(np.mean(values)), "worst_mm": float(max(worst)),
                "closure_mm": float(np.sqrt(np.mean(closures))) if closures else None,
                "predicted_mm": float(np.sqrt(np.mean(predicted))) if predicted else None, "taken": taken,
            }
        )  # fmt: skip
    return rows


def blunders(seeds: int) -> list[Row]:
    rows = []
    for columns, lines, count, size in (
        (8, 5, 3, 5.0),
        (8, 5, 3, 1.0),
        (8, 5, 10, 5.0),
        (8, 5, 20, 5.0),
        (4, 3, 3, 5.0),
    ):
        named = missed = right = apart = 0
        worst = []
        for seed in range(seeds):
            truth = panel(columns, lines, seed)
            chosen = np.random.default_rng([seed, 3]).choice(len(truth.overlaps), count, replace=False)
            wrong = {truth.overlaps[k]: shift(size, [seed, int(k)]) for k in chosen}
            result = build_network(truth.nodes(), draw_pairs(truth, seed, wrong))
            out = unused(result.pairs)
            named, missed, right = (
                named + len(out & set(wrong)),
                missed + len(set(wrong) - out),
                right + len(out - set(wrong)),
            )
            apart += sum(m.group > 0 for m in result.measurements)
            worst.append(max(errors_mm(truth, result)))
        rows.append(
            {
                "network": f"{columns} x {lines}", "pairs": len(truth.overlaps), "wrong": count, "size_mm": size,
                "networks": seeds, "named": named, "missed": missed, "right": right,
                "apart": apart, "worst_mm": float(max(worst)),
            }
        )  # fmt: skip
    return rows


def growth() -> list[Row]:
    rows = []
    first = panel(4, 3)
    build_network(first.nodes(), draw_pairs(first))  # what the first call makes once is not counted
    for columns, lines in ((10, 5), (10, 10), (20, 10), (20, 20), (40, 25)):
        truth = panel(columns, lines, 1)
        pairs, nodes = draw_pairs(truth, 1), truth.nodes()
        times = []
        for _ in range(3):
            started = time.process_time()
            result = build_network(nodes, pairs)
            times.append(time.process_time() - started)
        seconds = float(np.median(times))
        joint = result.joint.groups["0"] if result.joint else None
        assert joint is not None
        rows.append(
            {
                "measurements": len(nodes), "pairs": len(pairs), "seconds": seconds,
                "ms": 1000 * seconds / len(nodes), "blocks": len(joint.factor.below),
                "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            }
        )  # fmt: skip
    sizes = np.log([row["measurements"] for row in rows])
    exponent = float(np.polyfit(sizes, np.log([row["seconds"] for row in rows]), 1)[0])
    return [*rows, {"measurements": "fitted exponent of time", "seconds": exponent}]


def drawn(seeds: int, command: str) -> None:
    found = growth()  # first: peak memory is that of the process
    save_table(
        "network-growth",
        {"measurements": "measurements", "pairs": "pairs", "seconds": "processor time [s]", "ms": "each [ms]",
         "blocks": "blocks of the factor", "mib": "peak memory of the process [MiB]"},
        found, command, {"seconds": ".2f", "ms": ".1f", "mib": ".0f"},
    )  # fmt: skip
    honest = honesty(3 * seeds)
    save_table(
        "network-honesty",
        {"network": "network", "networks": "drawn", "nees": "mean NEES / 6", "worst_mm": "largest error [mm]",
         "closure_mm": "closure of loops, rms [mm]", "predicted_mm": "predicted [mm]", "taken": "pairs taken out"},
        honest, command, {"nees": ".2f", "worst_mm": ".3f", "closure_mm": ".4f", "predicted_mm": ".4f"},
    )  # fmt: skip
    wrong = blunders(seeds)
    save_table(
        "network-blunders",
        {"network": "panel", "pairs": "pairs", "wrong": "wrong ones", "size_mm": "off by [mm]", "networks": "drawn",
         "named": "named", "missed": "missed", "right": "right ones taken out",
         "apart": "measurements apart", "worst_mm": "largest error left [mm]"},
        wrong, command, {"size_mm": ".0f", "worst_mm": ".3f"},
    )  # fmt: skip
    for row in [*found, *honest, *wrong]:
        print(row)


def order() -> None:
    """Save how often measurements are prepared in the order in which pairs are tried."""
    from networks.ordered import orders

    save_table(
        "pairs-order",
        {"graph": "measurements", "pairs": "pairs", "each": "partners each", "kept": "kept",
         "sorted": "made ready, each, by names", "prepared": "in the order taken", "least": "at least"},
        orders(), "python benchmarks/network.py --order",
        {"each": ".1f", "sorted": ".2f", "prepared": ".2f", "least": ".2f"},
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rendered", choices=("small", "full"))
    parser.add_argument("--order", action="store_true", help="the order of pairs alone")
    parser.add_argument("--sizes", type=int, nargs="+", choices=(50, 100, 200, 400, 1000))
    parser.add_argument("--again", action="store_true", help="run the sizes and networks that are there, too")
    parser.add_argument("--workers", type=int, default=1, help="networks of --rendered side by side")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "planish-network",
                        help="folder for the measurements of --sizes and --rendered")  # fmt: skip
    arguments = parser.parse_args()
    if arguments.sizes is not None:
        from networks.grown import grown

        grown(arguments.sizes, arguments.cache, arguments.again)
    elif arguments.order:
        order()
    elif arguments.rendered is None:
        drawn(arguments.seeds, f"python benchmarks/network.py --seeds {arguments.seeds}")
    else:
        from networks.rendered import rendered

        rendered(arguments.rendered, arguments.cache, arguments.workers, arguments.again)
        if arguments.rendered == "small":
            from networks.faults import faults

            faults()


if __name__ == "__main__":
    main()
