"""The files of a sequence: the images to project, and the `capture.json` that describes what is recorded with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from planish import storage
from planish.errors import InputError
from planish.sensing.capture.manifest import SCHEMA
from planish.sensing.patterns.entries import Entry
from planish.sensing.patterns.sequences import entry_label, pattern_image

#: Names that `capture.json` gives to what is to be recorded and to be calibrated.
RIG_NAME = "rig.json"


def write_patterns(
    out: Path,
    sequence: Sequence[Entry],
    projector_px: tuple[int, int],
    cameras: Sequence[str] = ("A", "B"),
    gamma: float = 1.0,
) -> list[Path]:
    """Write the images to project, in that order, and `capture.json`; return the paths of the images.

    `capture.json` names the images that each camera records A_00.png, A_01.png, ..., and the rig rig.json.

    Parameters
    ----------
    out : Path
        Folder.
    sequence : sequence of Entry
        What to project.
    projector_px : tuple of int
        (width, height) of the projector.
    cameras : sequence of str
        Cameras that will record: "A", or "A" and "B".
    gamma : float
        Response of the projector, brightness = (value / 255)^gamma, that the images make up for; 1 = linear.

    Raises
    ------
    InputError
        Where the folder cannot be written or gamma is out of range.
    """
    if not 0.2 <= gamma <= 5:
        raise InputError("gamma", f"found {gamma:g}", "a number from 0.2 to 5")
    digits = max(2, len(str(len(sequence) - 1)))
    paths = [out / f"{k:0{digits}d}_{entry_label(entry)}.png" for k, entry in enumerate(sequence)]
    for path, entry in zip(paths, sequence, strict=True):
        done, data = cv2.imencode(".png", pattern_image(entry, projector_px, gamma))
        if not done:
            raise AssertionError(f"{path}: PNG encoding failed")
        _write(path, data)
    images = {name: [f"{name}_{k:0{digits}d}.png" for k in range(len(sequence))] for name in cameras}
    manifest = {
        "schema": SCHEMA,
        "rig": RIG_NAME,
        "images": images,
        "sequence": [entry.model_dump(exclude_none=True) for entry in sequence],
        "projector_px": list(projector_px),
    }
    storage.write_json(out / "capture.json", manifest)
    return paths


def _write(path: Path, data: np.ndarray) -> None:
    try:
        with storage.replacing(path) as temporary:
            data.tofile(temporary)
    except OSError as error:
        raise InputError(path, f"cannot be written ({error.strerror})", "a writable folder") from None
