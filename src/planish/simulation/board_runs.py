"""Runs of board captures: a scene of a printed board at places in front of a sensor, and its files.

The folder is one that `planish calibrate` reads: board.json and either A/ and B/, one image per view and camera, or one
folder with a capture.json per view. The truth lies beside it: true_rig.json, and true_boards.json with the places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from planish import storage
from planish.errors import InputError
from planish.geometry import Array, invert
from planish.options import thread_count
from planish.rig import Rig
from planish.sensing.patterns.entries import Black, Entry
from planish.simulation.boards import PrintedBoard
from planish.simulation.light import Light
from planish.simulation.render import render_capture
from planish.simulation.scenes import Background, Scene
from planish.simulation.sensor import Sensor
from planish.simulation.texture import BLANK
from planish.simulation.writing import write_capture, write_png

TRUTH_SCHEMA = "planish.board_truth/1"
#: Light of images without fringes: the room's alone, as bright as the projector would be.
ROOM_LIGHT = Light(specular=0.01, ambient=1.0)
#: Light of captures with fringes.
PROJECTOR_LIGHT = Light(specular=0.01, ambient=0.05)


def board_scene(
    rig: Rig, board: PrintedBoard, places: Sequence[Array], *, sequence: Sequence[Entry] | None = None, seed: int = 0,
    sensor: Sensor | None = None, light: Light | None = None, background: Background | None = None,
) -> Scene:  # fmt: skip
    """Return the scene of a printed board at the places T_sensor_board (4, 4); captures are named 01, 02, ...

    Without a sequence each capture is one image under room light. `sensor` and `light` replace the usual ones.
    """
    names = tuple(f"{k + 1:02d}" for k in range(len(places)))
    usual = ROOM_LIGHT if sequence is None else PROJECTOR_LIGHT
    return Scene(
        "board", board.surface, BLANK, light or usual, sensor or Sensor(seed=seed), names,
        tuple(board.T_object_board @ invert(T) for T in places), rig, seed, background,
        (Black(role="black"),) if sequence is None else tuple(sequence), board.printed,
    )  # fmt: skip


def write_boards(
    scene: Scene, board: PrintedBoard, out: Path, *, single: bool, threads: int | None = None,
    progress: Callable[[str], None] = lambda name: None,
) -> None:  # fmt: skip
    """Render and write all captures of a board's scene, what the board's file says, and the truth.

    With `single` only the first image of each capture, as OUT/A/NAME.png and OUT/B/NAME.png; else OUT/NAME/capture.json
    with all images and without a rig.

    Raises
    ------
    InputError
        Where `out` cannot be written.
    """
    shown = replace(scene, sequence=scene.sequence[:1]) if single else scene
    for index, name in enumerate(scene.names):
        progress(name)
        folders = [out / camera for camera in scene.rig.cameras] if single else [out / name]
        for folder in folders:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(folder, f"cannot be made ({error.strerror})", "a folder that can be written") from None
        images = render_capture(shown, index, threads)
        if single:
            for camera, stack in images.items():
                write_png(out / camera / f"{name}.png", stack[0])
        else:
            write_capture(out / name, scene, images, thread_count(threads), rig=None)
    storage.write_json(out / "board.json", board.board.model_dump(mode="json", by_alias=True, exclude_none=True))
    scene.rig.save(out / "true_rig.json")
    storage.write_json(out / "true_boards.json", _truth(scene, board))


def _truth(scene: Scene, board: PrintedBoard) -> dict[str, object]:
    return {
        "schema": TRUTH_SCHEMA,
        "points_board_mm": board.points_board.tolist(),
        "views": [
            {"name": name, "T_sensor_board": (invert(T) @ board.T_object_board).tolist()}
            for name, T in zip(scene.names, scene.T_object_sensor, strict=True)
        ],
    }
