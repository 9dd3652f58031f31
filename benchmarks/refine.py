"""The refinement: accuracy, efficiency, convergence, covariance, and beside its peers; resumable, one file per cell.

    python benchmarks/refine.py accuracy --parts 30              (errors over the coarse registration's grid)
    python benchmarks/refine.py scenes --pairs 20 --starts 25    (efficiency, convergence)
    python benchmarks/refine.py covariance --pairs 200 --noise 1 0.5 2
    python benchmarks/refine.py failures --pairs 2 --scale 0.5   (wrong optima, and what notices them)
    python benchmarks/refine.py beside --pairs 3 --peers PYTHON  (nothing else may run: it measures times)
    python benchmarks/refine.py tables

PYTHON is that of an environment with open3d and small_gicp. Cells stand in benchmarks/results/refine; those that are
there are kept. Full resolution, 0.32 mm per pixel.
"""

from __future__ import annotations

import argparse
from typing import Any

from coarse import FIRST_FULL
from refined_pairs import accuracy, beside, covariance, failures, scenes
from refined_pairs.pairs import KINDS
from refined_pairs.tables import FOLDER, save_tables
from shared.cells import cell_arguments, run_cells
from shared.environment import check_environment

#: One surface each, for the covariance; and a texture that is weak against its noise.
COVARIANCE_KINDS = ("plate_3", "plate_0.5", "cylinder_3", "door_3", "waves_3", "pipe_3")
#: What peers are compared on.
BESIDE_KINDS = ("plate_3", "plate_0.5", "cylinder_3", "door_3", "waves_3", "pipe_3")

Cells = dict[str, tuple[Any, ...]]


def accuracy_cells(arguments: argparse.Namespace) -> Cells:
    """Return one cell per part of the grid."""
    return {f"accuracy_{n:04d}": (n,) for n in range(FIRST_FULL, FIRST_FULL + arguments.parts)}


def scenes_cells(arguments: argparse.Namespace) -> Cells:
    """Return one cell per pair of a scene."""
    kinds = arguments.kinds or KINDS
    return {f"scenes_{k}_{n:03d}": (k, n, arguments.starts) for n in range(arguments.pairs) for k in kinds}


def covariance_cells(arguments: argparse.Namespace) -> Cells:
    """Return one cell per few pairs of a scene and noise."""
    blocks = -(-arguments.pairs // covariance.PAIRS_PER_CELL)
    return {
        f"covariance_{kind}_{arguments.scale:g}_{noise:g}_{block:03d}": (kind, noise, arguments.scale, block)
        for block in range(blocks)
        for noise in arguments.noise
        for kind in arguments.kinds or COVARIANCE_KINDS
    }


def failures_cells(arguments: argparse.Namespace) -> Cells:
    """Return one cell per pair of a scene."""
    kinds, scale = arguments.kinds or COVARIANCE_KINDS, arguments.scale
    return {f"failures_{k}_{scale:g}_{n:03d}": (k, n, scale) for n in range(arguments.pairs) for k in kinds}


def beside_cells(arguments: argparse.Namespace) -> Cells:
    """Return one cell per pair of a scene."""
    kinds = arguments.kinds or BESIDE_KINDS
    asked = arguments.peers, tuple(arguments.methods)
    return {f"beside_{k}_{n:03d}": (k, n, *asked) for n in range(arguments.pairs) for k in kinds}


def parse() -> argparse.Namespace:
    """Return what was asked for."""
    parser = cell_arguments(__doc__)
    parser.add_argument("study", choices=("accuracy", "scenes", "covariance", "failures", "beside", "tables"))
    parser.add_argument("--parts", type=int, default=30, help="of the grid")
    parser.add_argument("--pairs", type=int, default=20, help="of each scene")
    parser.add_argument("--kinds", nargs="+", choices=tuple(KINDS), help="scenes; default: those of the study")
    parser.add_argument("--starts", type=int, default=25, help="of each pair")
    parser.add_argument("--noise", type=float, nargs="+", default=[1.0], help="factors on the cameras' noise")
    parser.add_argument("--scale", type=float, default=1.0, help="resolution for covariance and failures")
    parser.add_argument("--peers", help="python of the peers' environment")
    parser.add_argument("--methods", nargs="+", choices=beside.PEERS, default=beside.PEERS, help="of the peers")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    again, workers = arguments.again, arguments.workers
    if arguments.peers:
        check_environment(arguments.peers, "open3d", "small_gicp")
    if arguments.study == "accuracy":
        run_cells(FOLDER, accuracy_cells(arguments), accuracy.run_part, workers, again)
    elif arguments.study == "scenes":
        run_cells(FOLDER, scenes_cells(arguments), scenes.run_pair, workers, again)
    elif arguments.study == "covariance":
        run_cells(FOLDER, covariance_cells(arguments), covariance.run_pairs, workers, again)
    elif arguments.study == "failures":
        run_cells(FOLDER, failures_cells(arguments), failures.run_pair, workers, again)
    elif arguments.study == "beside":
        # One after the other, so that the times are those of a machine that does nothing else.
        run_cells(FOLDER, beside_cells(arguments), beside.run_pair, 1, again)
    save_tables()


if __name__ == "__main__":
    main()
