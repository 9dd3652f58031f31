"""The image of the board that one camera took: of a board run, or of a capture, whose white image shows it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.sensing.calibrate.boards.manifest import ViewFiles
from planish.sensing.capture.images import read_grey
from planish.sensing.capture.manifest import Capture

#: Of several exposures the longest serves whose white image has fewer saturated pixels.
SATURATED_SHARE = 0.01


def read_board_image(view: ViewFiles, camera: str) -> tuple[str, NDArray[Any], NDArray[np.bool_] | None]:
    """Return name, grey values (H, W) and mask of one camera's image of the board."""
    if view.capture is None:
        file = view.images[camera]
        return f"{file.parent.name}/{file.name}", read_grey(file), None
    capture, mask = view.capture, view.capture.read_mask(camera)
    names = capture.manifest.images.A if camera == "A" else capture.manifest.images.B
    assert names is not None
    index, image = _board_image(capture, camera)
    if mask is not None and mask.shape != image.shape:
        raise InputError(
            f"{capture.path}: mask.{camera}",
            f"is {mask.shape[1]} x {mask.shape[0]} px",
            f"{image.shape[1]} x {image.shape[0]} px, as the images of camera {camera}",
        )
    return f"{view.name}: {names[index]}" if index >= 0 else f"{view.name}: mean of camera {camera}", image, mask


def read_grey_values(view: ViewFiles, camera: str) -> NDArray[Any]:
    """Return the grey values (H, W) of one camera's image of the board."""
    return read_board_image(view, camera)[1]


def _board_image(capture: Capture, camera: str) -> tuple[int, NDArray[Any]]:
    """Return the number in the sequence and the grey values (H, W) of the image that shows the board best.

    It is the white image; of several exposures the longest that is hardly saturated; without any (-1) the mean of the
    sequence, in which the patterns cancel.
    """
    sequence = capture.manifest.sequence
    white = [k for k, entry in enumerate(sequence) if entry.role == "white"]
    white.sort(key=lambda k: -(sequence[k].exposure_ms or 0.0))
    for k in white:
        image = capture.read_image(camera, k)
        full = np.iinfo(image.dtype).max
        if k == white[-1] or np.mean(image >= full) < SATURATED_SHARE:
            return k, image
    lit = [k for k, entry in enumerate(sequence) if entry.role != "black"] or list(range(len(sequence)))
    images = [capture.read_image(camera, k) for k in lit]
    return -1, np.asarray(np.mean(images, axis=0, dtype=np.float32))
