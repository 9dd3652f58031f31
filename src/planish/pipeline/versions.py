"""Versions that a result depends on."""

from __future__ import annotations

from importlib.metadata import version

import cv2
import numpy as np


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {"planish": version("planish"), "numpy": np.__version__, "opencv": cv2.__version__}
