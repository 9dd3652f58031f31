"""Grey images of a capture: reading one, with errors that name the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError

#: Grey values (H, W) of one image, uint8 or uint16.
GreyImage = NDArray[np.uint8] | NDArray[np.uint16]


def read_grey(path: Path) -> GreyImage:
    """Return a grey image (H, W), uint8 or uint16; errors name the file."""
    if not path.is_file():
        raise InputError(path, "no such file", "an image of the sequence")
    try:
        image: Any = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) if _whole(path) else None
    except (cv2.error, OSError):
        image = None
    if image is None:
        raise InputError(path, "cannot be decoded: truncated or not an image", "a grey image of 8 or 16 bit")
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise InputError(path, f"is {describe(image)}", "a grey image of 8 or 16 bit (one channel)")
    return image


def _whole(path: Path) -> bool:
    # Some versions of OpenCV return a truncated PNG with its missing rows black and no error: look for the end chunk.
    with path.open("rb") as file:
        start = file.read(8)
        if start != b"\x89PNG\r\n\x1a\n":
            return len(start) > 0
        file.seek(max(0, path.stat().st_size - 64))
        return b"IEND" in file.read()


def describe(image: NDArray[Any]) -> str:
    """Return size and type of an image in words."""
    channels = "" if image.ndim == 2 else f", {image.shape[2]} channels"
    return f"{image.shape[1]} x {image.shape[0]} px, {8 * image.dtype.itemsize} bit{channels}"
