"""The uniform scale: boards do not show it; the board's print and lengths measured by other means give it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Finding
from planish.sensing.capture.board import Board

#: A known length contradicts the print beyond this many standard deviations of their difference.
CONTRADICTION = 3.0


@dataclass(frozen=True)
class Scale:
    """Factor - 1 on all lengths against the board file's pitch, its standard deviation, and what was found."""

    value: float
    sigma: float
    findings: tuple[Finding, ...]


def scale_of(board: Board, points_board: Array) -> Scale:
    """Return the scale that print and known length agree on.

    Parameters
    ----------
    board : Board
        With `pitch_sigma` and, optionally, `known_length`.
    points_board : ndarray (N, 3)
        Its points as the board file states them [mm].

    Raises
    ------
    InputError
        Where the known length is between points that the board does not have.
    """
    sigma, known = board.pitch_sigma, board.known_length
    source = "stated by the board file (pitch_sigma); images of boards do not show it"
    if known is None:
        return Scale(0.0, sigma, (Finding("scale", 0.0, sigma, "", source),))
    columns, rows = board.grid
    ends = []
    for column, row in (known.first, known.second):
        if not (0 <= column < columns and 0 <= row < rows):
            raise InputError(
                "board.known_length", f"found the point ({column}, {row})",
                f"(column, row) from (0, 0) to ({columns - 1}, {rows - 1})",
            )  # fmt: skip
        ends.append(points_board[row * columns + column])
    nominal = float(np.linalg.norm(ends[1] - ends[0]))
    if nominal == 0:
        raise InputError("board.known_length", "found the same point twice", "two points of the board")
    measured, known_sigma = known.length_mm / nominal - 1, known.sigma_mm / nominal
    apart = float(np.hypot(sigma, known_sigma))
    told = f"{known.length_mm:.6g} mm against {nominal:.6g} mm by the pitch"
    if abs(measured) > CONTRADICTION * apart:
        warning = (
            f"the known length contradicts the pitch: {told}, {100 * measured:+.4f} % off with a standard deviation of "
            f"{100 * apart:.4f} %; neither is believed: the scale is that of the pitch, its standard deviation the "
            "difference. Measure both again"
        )
        finding = Finding("known length against pitch", measured, apart, "", told, warning)
        enlarged = max(sigma, abs(measured))
        return Scale(0.0, enlarged, (finding, Finding("scale", 0.0, enlarged, "", "known length and pitch disagree")))
    weight = 1.0 if sigma == known_sigma == 0 else sigma**2 / (sigma**2 + known_sigma**2)
    value, combined = weight * measured, float(np.sqrt(weight) * known_sigma)
    return Scale(value, combined, (
        Finding("known length against pitch", measured, apart, "", told),
        Finding("scale", value, combined, "", "weighted mean of pitch and known length"),
    ))  # fmt: skip
