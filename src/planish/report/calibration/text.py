"""What the report of a calibration says in words."""

from __future__ import annotations

from collections.abc import Sequence

from planish.report.calibration.numbers import percent, pixels, significant
from planish.report.text import count
from planish.sensing.calibrate.judge.advice import device_title
from planish.sensing.calibrate.judge.expected_error import ExpectedError, map_rms
from planish.sensing.calibrate.judge.views import depths_mm
from planish.sensing.calibrate.result import Calibration
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Chessboard

#: Length for which the statement on the scale gives an example [mm].
EXAMPLE_MM = 300.0

RESIDUALS = (
    "Left: residuals (observed less adjusted), magnified as the arrow below the image says. Middle: means of all "
    "residuals of a cell, magnified more; orange where noise alone makes them so large in one cell of a thousand: "
    "there lens or board differ from their models. Right: both components over "
    "the standard deviation of each point, which is small where its detection says so."
)
ERROR_DEFINITION = (
    "Standard deviations by the calibration alone, from its covariance: the same in all measurements. The noise of a "
    "measurement's own images comes on top (sigma_mm of its points).",
    "In the sensor frame: root mean square length of the 3D error; it counts where points are compared with what is "
    "fixed to the sensor, a robot for example.",
    "Form: what is left when the best rigid motion of the whole map is taken off; it counts where a part is compared "
    "with its model or its own other measurements.",
    "Scale: the part of the form's error that is one factor on all lengths. Warp: the rest.",
)


def capital(text: str) -> str:
    """Return text with a capital first letter, the others as they are."""
    return text[:1].upper() + text[1:]


def title(devices: Sequence[str]) -> str:
    """Return "camera A, camera B and projector"."""
    names = [device_title(device) for device in devices]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def board_text(board: Board) -> str:
    """Return the board in words."""
    columns, rows = board.grid
    x, y = board.pitches_mm
    pitch = f"{x:g} mm" if x == y else f"{x:g} x {y:g} mm"
    if isinstance(board, Chessboard):
        return f"a chessboard of {columns} x {rows} inner corners, pitch {pitch}"
    if isinstance(board, Charuco):
        return f"a ChArUco board of {board.squares[0]} x {board.squares[1]} squares of {pitch}"
    kind = "an asymmetric grid" if isinstance(board, AsymmetricCircles) else "a grid"
    return f"{kind} of {columns} x {rows} circles, pitch {pitch}"


def verdict(calibration: Calibration, errors: Sequence[ExpectedError]) -> tuple[str, list[str]]:
    """Return a class ("" or "partial") and the sentences of the summary, the most important one first."""
    devices = tuple(calibration.rig.devices)
    views = count(len(calibration.T_A_board), "view")
    first = f"{title(devices)} calibrated from {views} of {board_text(calibration.observations.board)}."
    sentences = [capital(first), _residuals(calibration)]
    sentences += [error_sentence(calibration, error) for error in errors]
    if len(devices) > 1:
        sentences.append(scale_sentence(calibration))
    warnings = sum(bool(finding.warning) for finding in calibration.findings)
    if warnings:
        sentences.append(f"{count(warnings, 'warning')}, see below.")
    return "partial" if warnings else "", sentences


def _residuals(calibration: Calibration) -> str:
    parts = []
    for device in calibration.rig.devices:
        left_out = calibration.left_out_rms_px.get(device)
        tail = "" if left_out is None else f" (left out: {pixels(left_out)} px)"
        parts.append(f"{pixels(calibration.rms_px(device))} px in {device_title(device)}{tail}")
    end = " Left out: a view's residuals to a rig adjusted without it." if calibration.left_out_rms_px else ""
    return f"Residuals, root mean square of their length: {', '.join(parts)}.{end}"


def error_sentence(calibration: Calibration, error: ExpectedError) -> str:
    """Return the expected error of one pair of devices in words."""
    depth = depths_mm(calibration)[1]
    pair = f"{device_title(error.own)} with {device_title(error.other)}"
    return (
        f"Expected 3D error by the calibration at the working distance of {depth:.0f} mm, {pair}: "
        f"{significant(map_rms(error.form_mm))} mm rms of form ({significant(map_rms(error.scale_mm))} mm of it one "
        f"factor on all lengths), {significant(map_rms(error.sensor_mm))} mm rms in the sensor frame."
    )


def scale_sentence(calibration: Calibration) -> str:
    """Return on what the uniform scale rests, and how sure it is."""
    value, sigma = calibration.scale
    board = calibration.observations.board
    example = f"that is {significant(sigma * EXAMPLE_MM)} mm over {EXAMPLE_MM:.0f} mm"
    if board.known_length is None:
        return (
            "The uniform scale is not observable from boards: it rests on the pitch, whose standard deviation is "
            f"{percent(sigma)}, {example}."
        )
    known = board.known_length
    return (
        f"The uniform scale is not observable from boards: it rests on the pitch ({percent(board.pitch_sigma)}) and on "
        f"the known length of {known.length_mm:g} mm ± {known.sigma_mm:g} mm. Together they put it {100 * value:+.4f} "
        f"% off the pitch with a standard deviation of {percent(sigma)}, {example}."
    )
