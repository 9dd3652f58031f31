"""Reading point clouds of other scanners."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyParseError

from planish.errors import InputError
from planish.geometry import Array


def read_ply_points(path: Path) -> Array:
    """Return the points (N, 3) [mm] of a PLY file in its own order, missing ones NaN.

    Organised clouds mark a missing point by NaN or by (0, 0, 0): both become NaN.

    Raises
    ------
    InputError
        Where the file is missing, damaged, or has no vertices with x, y, z.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "no such file", "a PLY file")
    try:
        vertex = PlyData.read(str(path))["vertex"]
        points = np.column_stack([np.asarray(vertex[axis], float) for axis in "xyz"])
    except (PlyParseError, KeyError, ValueError, EOFError, UnicodeDecodeError, OSError) as error:
        raise InputError(path, f"cannot be read ({error})", "a whole PLY file whose vertices have x, y, z") from None
    points[(points == 0).all(1) | ~np.isfinite(points).all(1)] = np.nan
    if not np.isfinite(points[:, 0]).any():
        raise InputError(path, "holds no point", "at least one point that is neither NaN nor (0, 0, 0)")
    return points
