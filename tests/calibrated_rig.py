"""Rigs with the covariance that a calibration with boards would give them, whatever their sensor frame."""

from __future__ import annotations

from dataclasses import replace

from planish.rig import Rig
from planish.sensing.capture.board import Chessboard
from planish.simulation.board_places import board_places
from planish.simulation.boards import PrintedBoard
from planish.simulation.rigs import with_expected_covariance

#: Standard deviation of a corner in a camera and of its code in the projector [px].
CORNER_PX = 0.05
#: Relative standard deviation of the board's pitch, that is of all lengths.
PITCH_SIGMA = 1e-4
VIEWS = 20
BOARD = PrintedBoard(Chessboard(schema="planish.board/1", kind="chessboard", corners=(12, 9), pitch_mm=20.0))


def with_calibration(rig: Rig, corner_px: float = CORNER_PX) -> Rig:
    """Return the rig with the covariance of a calibration by 20 boards; its sensor frame goes with camera A.

    Parameters of a device act in its own frame, so that the covariance is the same in every sensor frame that goes with
    camera A.
    """
    places = board_places(rig, BOARD, VIEWS, seen_share=0.7)
    stated = with_expected_covariance(rig, BOARD, places, corner_px, pitch_sigma=PITCH_SIGMA)
    return replace(rig, covariance=stated.covariance, covariance_parameters=stated.covariance_parameters)
