"""`planish simulate-board`: render a calibration board at many places, as `planish calibrate` reads it, with truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from planish.cli import console
from planish.cli.simulate import read_sequence
from planish.errors import InputError
from planish.rig import Rig
from planish.sensing.capture.board import Board, load_board, parse_board
from planish.sensing.patterns.sequences import SEQUENCES
from planish.simulation.board_places import board_places
from planish.simulation.board_runs import board_scene, write_boards
from planish.simulation.boards import PrintedBoard
from planish.simulation.scenes import Background
from planish.simulation.sensor import Sensor, reference_rig

#: What is simulated without a board's file.
USUAL_BOARD = {"schema": "planish.board/1", "kind": "chessboard", "corners": [11, 8], "pitch_mm": 20.0}
#: A background behind the deepest corner of any board that the reference sensor is shown, in its frame.
BACKGROUND_MM = -450.0


def simulate_board(
    out: Annotated[Path, typer.Option(help="Folder for board.json, the images and the truth.")],
    board: Annotated[
        Path | None, typer.Option(help="board.json; default: a chessboard of 11 x 8 corners every 20 mm.")
    ] = None,
    views: Annotated[int, typer.Option(help="Number of places of the board.")] = 20,
    seed: Annotated[int, typer.Option(help="Everything random follows from it.")] = 0,
    fringes: Annotated[
        bool, typer.Option(help="Captures with all projected images; else one image per view and camera in A/ and B/.")
    ] = False,
    sequence: Annotated[
        str, typer.Option(help=f"With --fringes: {', '.join(SEQUENCES)}, or a capture.json of `planish patterns`.")
    ] = "reference",
    axes: Annotated[str, typer.Option(help="Encoded projector axes: u, v or both.")] = "both",
    cameras: Annotated[Literal["A", "AB"], typer.Option(help="The cameras that take images.")] = "AB",
    width_scale: Annotated[float, typer.Option(help="Camera resolution against 1388 x 1038 px.")] = 1.0,
    bits: Annotated[int, typer.Option(help="8 or 16.")] = 8,
    noise_factor: Annotated[float, typer.Option(help="Factor on the noise of the images.")] = 1.0,
    tilt_deg: Annotated[float, typer.Option(help="Largest tilt of the board.")] = 35.0,
    sagitta_mm: Annotated[float, typer.Option(help="Bends the board: height of its middle over its border.")] = 0.0,
    bend_axis_deg: Annotated[float, typer.Option(help="Direction of the bend's axis, from x to y.")] = 90.0,
    scale: Annotated[float, typer.Option(help="True pitch over that of the file.")] = 1.0,
    pitch_ratio: Annotated[float, typer.Option(help="True pitch along y over that along x, against the file.")] = 1.0,
    light_discs: Annotated[bool, typer.Option(help="Circle grids: light discs on dark ground.")] = False,
    background: Annotated[bool, typer.Option(help="A textured background behind the board.")] = False,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
) -> None:
    """Render a calibration board as the reference sensor sees it at many places, with true_rig.json and the places."""
    _require(0.05 <= width_scale <= 2, "width scale", width_scale, "a factor from 0.05 to 2")
    _require(seed >= 0, "seed", seed, "a whole number >= 0")
    made = PrintedBoard(
        _read_board(board), (scale, scale * pitch_ratio), sagitta_mm, bend_axis_deg, light_discs=light_discs
    )
    rig = _rig(width_scale, cameras)
    # Fringes on parts of the board that the projector does not reach would be of no use to it.
    devices = tuple(rig.devices) if fringes else tuple(rig.cameras)
    places = board_places(rig, made, views, seed, tilt_deg=tilt_deg, devices=devices)
    scene = board_scene(
        rig, made, places, sequence=read_sequence(sequence, axes) if fringes else None, seed=seed,
        sensor=Sensor(bits=bits, noise_factor=noise_factor, seed=seed),
        background=Background(BACKGROUND_MM) if background else None,
    )  # fmt: skip
    with console.status("") as status:
        write_boards(
            scene, made, out, single=not fringes, threads=threads,
            progress=lambda name: status.update(f"rendering {name}"),
        )  # fmt: skip
    console.print(f"{len(places)} views of a {made.board.kind} in {out}, its truth beside them", highlight=False)


def _read_board(path: Path | None) -> Board:
    return parse_board(USUAL_BOARD, "board") if path is None else load_board(path)


def _rig(width_scale: float, cameras: str) -> Rig:
    rig = reference_rig(width_scale)
    return replace(rig, cameras={name: rig.cameras[name] for name in cameras})


def _require(condition: bool, subject: str, found: object, expected: str) -> None:
    if not condition:
        raise InputError(subject, f"found {found}", expected)


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command("simulate-board")(simulate_board)
