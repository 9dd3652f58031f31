"""Which pairs are tried: found overlaps, time and memory from 50 to 1000 measurements of a drawn panel.

    python benchmarks/candidates.py    # minutes

Drawn keypoints: measurements stand in a grid and overlap by 35 % with each neighbour. Each finds a share of the places
that it sees; the rest are places that only it has. Descriptors have so much noise that of the places that two
neighbours both found three quarters have each other as nearest descriptors (printed): a lesser share than in rendered
pairs of good texture, a greater one than in those of weak texture. There are 2000 keypoints per measurement, where full
resolution has 5000.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np

from planish.registration.candidates.choose import CandidateOptions, choose_pairs
from planish.registration.keypoints.keypoints import Keypoints
from render_tables import save_table

Row = dict[str, Any]

#: Grids of the growth.
GRIDS = ((10, 5), (10, 10), (20, 10), (20, 20), (40, 25))
#: A measurement sees so many cells of the panel along both axes; the next one begins so many further on: 35 % overlap.
SEEN_CELLS, STEP_CELLS = 20, 13
#: Places per cell, the share of them that a measurement finds, and keypoints that no other one finds.
PLACES, FOUND, OWN = 4, 0.5, 1200
#: Dimensions that descriptors vary in, their deviation, and that of the noise per value.
DIMENSIONS, DEVIATION, NOISE = 24, 30.0, 30.0


class Panel(Mapping[str, Keypoints]):
    """Keypoints of the measurements of a drawn panel, each drawn when it is asked for."""

    def __init__(self, columns: int, rows: int, seed: int = 1) -> None:
        self.seed, self.seconds = seed, 0.0
        self.at = {f"{c:03d}-{r:03d}": (c, r) for c, r in product(range(columns), range(rows))}
        axes = np.random.default_rng(seed).normal(size=(DIMENSIONS, 128))
        self.axes = axes / np.linalg.norm(axes, axis=0) * DEVIATION

    def draw(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return descriptors (N, 128) and the places (N,) that they describe; negative where no other finds them."""
        column, row = self.at[name]
        # Where and how a measurement looks is its own; what a cell holds is the same for all.
        rng = np.random.default_rng([self.seed, 1, column, row])
        seen = product(range(SEEN_CELLS), range(SEEN_CELLS))
        cells = [((STEP_CELLS * column + i) << 24) + STEP_CELLS * row + j for i, j in seen]
        shared = np.concatenate([self._cell(cell) for cell in cells])
        places = (np.array(cells)[:, None] * PLACES + np.arange(PLACES)).ravel()
        found = rng.random(len(shared)) < FOUND
        words = np.concatenate([shared[found], rng.normal(size=(OWN, DIMENSIONS))]) @ self.axes
        words = np.clip(128 + words + rng.normal(0, NOISE, words.shape), 0, 255).astype(np.uint8)
        own = -1 - np.arange(OWN) - OWN * list(self.at).index(name)
        order = rng.permutation(len(words))
        return words[order], np.concatenate([places[found], own])[order]

    def __getitem__(self, name: str) -> Keypoints:
        started = time.process_time()
        found = _keypoints(self.draw(name)[0])
        self.seconds += time.process_time() - started
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self.at)

    def __len__(self) -> int:
        return len(self.at)

    def _cell(self, number: int) -> np.ndarray:
        return np.random.Generator(np.random.Philox(key=[number, self.seed])).normal(size=(PLACES, DIMENSIONS))

    def overlapping(self, diagonal: bool) -> set[tuple[str, str]]:
        """Return the pairs of neighbours: beside each other (35 % overlap), or at a corner (12 %)."""
        steps = ((1, 1), (1, -1)) if diagonal else ((1, 0), (0, 1))
        names = {place: name for name, place in self.at.items()}
        beside = (
            (name, names[c + dc, r + dr])
            for name, (c, r) in self.at.items()
            for dc, dr in steps
            if (c + dc, r + dr) in names
        )
        return {(min(pair), max(pair)) for pair in beside}


def _keypoints(words: np.ndarray) -> Keypoints:
    n = len(words)
    none, pixels = np.zeros(n), np.zeros((n, 2))
    frames = np.zeros((n, 3, 3))
    return Keypoints(np.zeros((n, 3)), frames, none + 4, pixels, words, np.zeros(n, np.intp), pixels, none)


def right_neighbours() -> float:
    """Return in percent how many places that two neighbours both found have each other as nearest descriptors."""
    (a, of_a), (b, of_b) = (Panel(2, 1).draw(name) for name in Panel(2, 1))
    a, b = a.astype(np.float32), b.astype(np.float32)
    nearest = ((a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T).argmin(1)
    return 100 * float((of_a == of_b[nearest]).sum()) / len(np.intersect1d(of_a, of_b))


def growth() -> list[Row]:
    rows = []
    for columns, lines in GRIDS:
        panel = Panel(columns, lines)
        started = time.process_time()
        pairs = set(choose_pairs(panel, CandidateOptions()).pairs)
        seconds = time.process_time() - started - panel.seconds
        n = len(panel)
        found = [len(pairs & panel.overlapping(d)) / len(panel.overlapping(d)) for d in (False, True)]
        rows.append(
            {
                "measurements": n, "possible": n * (n - 1) // 2, "pairs": len(pairs), "each": len(pairs) / n,
                "beside": 100 * found[0], "corner": 100 * found[1], "seconds": seconds, "ms": 1000 * seconds / n,
                "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            }
        )  # fmt: skip
        print(rows[-1], flush=True)
    sizes = np.log([row["measurements"] for row in rows])
    slope = {key: float(np.polyfit(sizes, np.log([row[key] for row in rows]), 1)[0]) for key in ("pairs", "seconds")}
    return [*rows, {"measurements": "fitted exponent"} | slope]


def drawn() -> None:
    save_table(
        "candidates-growth",
        {"measurements": "measurements", "possible": "possible pairs", "pairs": "tried", "each": "per measurement",
         "beside": "of 35 % overlap found [%]", "corner": "of 12 % overlap found [%]",
         "seconds": "processor time [s]", "ms": "each [ms]", "mib": "peak memory [MiB]"},
        growth(), "python benchmarks/candidates.py",
        {"pairs": ".4g", "each": ".1f", "beside": ".1f", "corner": ".1f", "seconds": ".3g", "ms": ".1f", "mib": ".0f"},
    )  # fmt: skip


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(f"nearest descriptors of two neighbours that are right: {right_neighbours():.0f} %")
    drawn()


if __name__ == "__main__":
    main()
