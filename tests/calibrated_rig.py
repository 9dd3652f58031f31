"""Rigs with the covariance of a calibration by a board, in their own sensor frame, which goes with camera A."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from planish.rig import Rig
from planish.sensing.capture.board import parse_board
from planish.simulation.board_places import board_places
from planish.simulation.boards import PrintedBoard
from planish.simulation.rigs import with_expected_covariance
from planish.simulation.sensor import reference_rig

#: Standard deviation of a corner in a camera and of its code in the projector [px].
CORNER_PX = 0.05
#: Relative standard deviation of the board's pitch, that is of all lengths.
PITCH_SIGMA = 1e-4
VIEWS = 20
STATED = {"schema": "planish.board/1", "kind": "chessboard", "corners": (12, 9), "pitch_mm": 22.0}


@lru_cache
def _board():
    board = PrintedBoard(parse_board(STATED, "board"))
    return board, board_places(reference_rig(), board, VIEWS, 0, devices=("A", "B"), seen_share=0.8)


def with_calibration(rig: Rig, corner_px: float = CORNER_PX) -> Rig:
    """Return the rig with the covariance of a calibration by VIEWS views of one board."""
    board, places = _board()
    stated = with_expected_covariance(rig, board, places, corner_px, pitch_sigma=PITCH_SIGMA)
    return replace(rig, covariance=stated.covariance, covariance_parameters=stated.covariance_parameters)
