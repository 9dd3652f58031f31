"""What cameras and projector saw of the board: the input of the adjustment, whatever it was found with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.sensing.capture.board import Board

Index = NDArray[np.intp]


@dataclass(frozen=True)
class BoardPoints:
    """Points of the board in one image.

    Parameters
    ----------
    index : ndarray (n,) int
        Which points, as rows of `board_points`.
    pixel_px : ndarray (n, 2)
        Where they were seen [px].
    sigma_px : ndarray (n,)
        Their standard deviation as the detection states it [px]; the adjustment scales it, per device, to what it
        finds.
    """

    index: Index
    pixel_px: Array
    sigma_px: Array


@dataclass(frozen=True)
class CodedPoints:
    """Places of the projector that the code puts near points of the board, through the image of one camera.

    Near a point the decoded position is position_px + jacobian (p - camera_px) for a camera pixel p. The adjustment
    evaluates it at the camera's adjusted image of the point, so that the camera's own error does not enter.

    Parameters
    ----------
    camera : str
        "A" or "B": the camera that saw the code.
    index : ndarray (n,) int
        Which points, as rows of `board_points`.
    camera_px : ndarray (n, 2)
        Pixels at which `position_px` was evaluated [px].
    position_px : ndarray (n, 2)
        Projector position (u, v) there [projector px].
    jacobian : ndarray (n, 2, 2)
        Its derivative by the camera's pixel.
    sigma_px : ndarray (n,)
        Standard deviation of each coordinate of the position [projector px].
    """

    camera: str
    index: Index
    camera_px: Array
    position_px: Array
    jacobian: Array
    sigma_px: Array


@dataclass(frozen=True)
class BoardView:
    """One position of the board, seen by some of the devices at the same time.

    Parameters
    ----------
    name : str
        Unique name within the calibration.
    cameras : mapping of BoardPoints
        Per camera that found the board.
    code : tuple of CodedPoints
        Projector positions, per camera that decoded them; empty without fringe images.
    images : mapping of str
        Per camera, the image's name for messages.
    """

    name: str
    cameras: Mapping[str, BoardPoints]
    code: tuple[CodedPoints, ...]
    images: Mapping[str, str]


@dataclass(frozen=True)
class BoardObservations:
    """All views of one board.

    Parameters
    ----------
    board : Board
        What is printed on it.
    size_px : mapping
        Per camera, (width, height) of its images.
    projector_px : tuple of int or None
        (width, height) of the projector; None where no code was projected.
    views : tuple of BoardView
        Those in which some camera found the board, in the order of the input.
    missed : mapping of str
        Image name to the reason why it is not used ("no board found", ...).
    """

    board: Board
    size_px: Mapping[str, tuple[int, int]]
    projector_px: tuple[int, int] | None
    views: tuple[BoardView, ...]
    missed: Mapping[str, str]

    @property
    def devices(self) -> tuple[str, ...]:
        """Names of the devices: cameras, then "projector"."""
        return (*sorted(self.size_px), *(("projector",) if self.projector_px is not None else ()))
