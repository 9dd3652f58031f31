"""The projector's code on the board, decoded as in any capture but without a rig."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from planish.errors import InputError
from planish.sensing.calibrate.boards.code import code_points
from planish.sensing.calibrate.observations import BoardPoints, CodedPoints
from planish.sensing.capture.board import Board
from planish.sensing.capture.manifest import Capture, ImageReader
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.checks.slips import observe_consistent
from planish.sensing.decode import DecodeOptions
from planish.sensing.exposures import merge_exposures, split_exposures
from planish.sensing.observe import Observation
from planish.sensing.waveform.straighten import straighten


def decode_code(
    capture: Capture, points: Mapping[str, BoardPoints], board: Board, threads: int
) -> tuple[CodedPoints, ...]:
    """Return the projector's positions at the points, per camera that found the board."""
    if not points:
        return ()
    if capture.manifest.projector_px is None:
        raise InputError(capture.path, "names no size of the projector", "'projector_px', its [width, height]")
    cameras = tuple(points)
    exposures = split_exposures(capture)
    each = [_observe(part, cameras, threads) for _, part in exposures]
    layout = read_layouts(exposures[0][1].manifest, str(capture.path))[0]
    found = []
    for camera in cameras:
        seen = merge_exposures([item[camera] for item in each], [time for time, _ in exposures])
        mask = capture.read_mask(camera)
        if mask is not None:
            seen = seen.without(~mask)
        coded = code_points(straighten(seen, layout.codes, camera).phases, points[camera], board, camera)
        if coded is not None:
            found.append(coded)
    return tuple(found)


def _observe(capture: Capture, cameras: tuple[str, ...], threads: int) -> dict[str, Observation]:
    layout = read_layouts(capture.manifest, str(capture.path))[0]
    again = partial(capture.read_images, threads=threads)
    with ImageReader(capture, cameras, threads) as reader:
        return observe_consistent(reader.take, again, cameras, layout, DecodeOptions(), str(capture.path), threads)
