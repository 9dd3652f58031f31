"""Images that show enough of the board to take part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planish.geometry import Array
from planish.measurement import Finding
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.problem import Mask, Problem
from planish.sensing.calibrate.observations import BoardObservations

#: Fewer points do not hold a place of the board and tell of the lens as well.
LEAST_POINTS = 8
#: Width of the seen points across their longest direction, as a standard deviation in pitches: less than two rows.
LEAST_WIDTH = 0.4


def only_usable(problem: Problem, observations: BoardObservations) -> tuple[Problem, tuple[Finding, ...]]:
    """Return the problem without images of too few points or of a single row of them, which are named."""
    pitch = min(observations.board.pitches_mm)
    blocks, findings = [], []
    for block in problem.blocks:
        bad = block.views & ~np.array([_holds(problem.points_board, seen, pitch) for seen in block.seen])
        for v in np.flatnonzero(bad):
            view = observations.views[v]
            through = block.through or block.device
            image = view.images.get(through, through)
            what = f"the projector's code in {image}" if block.device == PROJECTOR else f"image {image}"
            told = (
                f"view {view.name}: {what} shows {block.seen[v].sum()} points of the board, too few to hold its place"
            )
            findings.append(
                Finding(f"points in {what}", float(block.seen[v].sum()), None, "", told, f"{told}; not used")
            )
        blocks.append(block.without(bad[:, None]))
    return replace(problem, blocks=tuple(blocks)), tuple(findings)


def _holds(points_board: Array, seen: Mask, pitch_mm: float) -> bool:
    points = points_board[seen, :2]
    if len(points) < LEAST_POINTS:
        return False
    width = np.linalg.svd(points - points.mean(0), compute_uv=False)[1] / np.sqrt(len(points))
    return bool(width >= LEAST_WIDTH * pitch_mm)
