"""One device alone: its first calibration, from which images that do not fit are already gone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from planish.rig import Camera
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.lens_models import FEW_VIEWS, held_pseudo
from planish.sensing.calibrate.adjust.problem import Block, Free, Problem, State, placed
from planish.sensing.calibrate.adjust.robust import Adjusted, adjust_robustly
from planish.sensing.calibrate.adjust.start import place_boards, start_camera

#: The code is decoded at the corners; a corner farther away belongs to another image [px].
NEAR_PX = 5.0


def adjust_single(problem: Problem, block: Block, size_px: tuple[int, int], share: float) -> Adjusted:
    """Return the calibration of one device by its own images of the board; its frame is the sensor frame.

    With few views the principal point and the form of the pixels are held by weak pseudo-observations.
    """
    camera = start_camera(block, problem.points_board, size_px)
    few = int(block.views.sum()) < FEW_VIEWS
    pseudo = held_pseudo(block.device, camera, ("k1",)) if few else ()
    alone = replace(problem, blocks=(block,), pseudo=pseudo)
    # The places of the boards are better with a lens. Outliers are sought with a rich one, lest corners count as such.
    item = _adjust(replace(alone, modes=problem.modes[:0]), block, camera, ("k1",), share)
    rich = ("k1",) if few else ("k1", "k2", "p1", "p2", "k3")
    return _adjust(alone, block, item.state.devices[block.device], rich, share)


def _adjust(problem: Problem, block: Block, camera: Camera, coefficients: Sequence[str], share: float) -> Adjusted:
    places = place_boards(block, problem.points_board, camera, block.views)
    known = placed(places)
    kept = replace(problem, blocks=(block.without(~known[:, None]),))
    places[~known] = np.eye(4)
    free = Free.of({block.device: coefficients}, block.device, len(problem.modes))
    start = State({block.device: camera}, places, np.zeros(len(problem.modes)))
    return adjust_robustly(kept, start, free, share)


def as_camera(problem: Problem) -> Block:
    """Return what the projector saw as if it were a camera: its code at the corners as the cameras found them."""
    merged: Block | None = None
    for block in problem.blocks_of(PROJECTOR):
        assert block.through is not None
        assert block.jacobian is not None
        assert block.camera_px is not None
        corners = problem.blocks_of(block.through)[0]
        offset = corners.observed_px - block.camera_px
        near = corners.seen & (np.linalg.norm(offset, axis=-1) < NEAR_PX)
        offset = np.where(near[..., None], offset, 0.0)
        position = block.observed_px + (block.jacobian @ offset[..., None])[..., 0]
        if merged is None:
            merged = Block(PROJECTOR, None, position, block.sigma_px)
        else:
            other = ~merged.seen
            merged = Block(
                PROJECTOR, None, np.where(other[..., None], position, merged.observed_px),
                np.where(other, block.sigma_px, merged.sigma_px),
            )  # fmt: skip
    assert merged is not None
    return merged
