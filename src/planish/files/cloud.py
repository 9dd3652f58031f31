"""Registered measurements as one binary PLY cloud, for CloudCompare, MeshLab and others.

Positions are float32: at 1 m from the origin they resolve 0.06 micrometres, a hundredth of the accuracy to be stated,
at half the size of float64; and some readers round float64 to float32 anyway.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planish import storage
from planish.errors import InputError
from planish.evaluation.prepared import Prepared
from planish.geometry import Array, transform_points
from planish.measurement import Map, Measurement
from planish.registration.result import PlacedMeasurement, Registration
from planish.registration.surface import Surface

#: One point of the file; `measurement` is the index into the names listed in the header's comments.
POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz", "intensity")] + [("measurement", "<u2")])
_PLY_TYPES = {"<f4": "float", "<u2": "ushort"}


def intensity(measurement: Measurement) -> Map:
    """Return the grey value (H, W) of the organising camera with the least noise that the measurement has."""
    view = measurement.views.get(measurement.organised_on)
    images = () if view is None else (view.mean, view.white, view.modulation)
    return next((image for image in images if image is not None), np.zeros(measurement.shape, np.float32))


def cloud(
    measurement: Measurement, T_world_measurement: Array, index: int, surface: Surface, step_px: int = 1
) -> NDArray[np.void]:
    """Return the points (N,) of dtype POINT of a measurement in world, every `step_px`-th pixel in both directions.

    Normals point to the sensor; a point without a local surface has the normal (0, 0, 0).
    """
    pixels = (slice(step_px // 2, None, step_px),) * 2
    valid = measurement.valid[pixels]
    points = transform_points(T_world_measurement, measurement.points_sensor[pixels][valid])
    normals = surface.normals_sensor[pixels][valid] @ T_world_measurement[:3, :3].T
    out = np.empty(len(points), POINT)
    for axis, name in enumerate("xyz"):
        out[name] = points[:, axis]
        out[f"n{name}"] = np.nan_to_num(normals[:, axis], nan=0.0)
    out["intensity"] = np.nan_to_num(intensity(measurement)[pixels][valid], nan=0.0)
    out["measurement"] = index
    return out


def write_ply(path: Path, clouds: Iterable[NDArray[np.void]], comments: Sequence[str], most: int) -> None:
    """Write clouds of dtype POINT as one binary little-endian PLY, one after the other; `most` points altogether."""
    size = len(_header(most, comments, 0)) + _PADDING
    with storage.replacing(Path(path)) as temporary, temporary.open("wb") as file:
        file.write(b"\0" * size)
        count = 0
        for points in clouds:
            file.write(np.ascontiguousarray(points).data)
            count += len(points)
        # The number of points stands before them, and is known after them.
        file.seek(0)
        file.write(_header(count, comments, size))


#: Bytes of a comment that fills the header up.
_PADDING = len("comment \n")


def _header(count: int, comments: Sequence[str], size: int) -> bytes:
    """Return the header, filled up to `size` bytes by a comment of spaces."""
    lines = ["ply", "format binary_little_endian 1.0", "comment units mm", *(f"comment {text}" for text in comments)]
    tail = [f"element vertex {count}"]
    tail += [f"property {_PLY_TYPES[POINT[name].str]} {name}" for name in POINT.names or ()]
    missing = size - len("\n".join([*lines, *tail, "end_header", ""]).encode("utf-8"))
    fill = ["comment".ljust(missing - 1)] if missing > 0 else []
    return "\n".join([*lines, *fill, *tail, "end_header", ""]).encode("utf-8")


def write_registered(
    out: Path, registration: Registration, measurements: Mapping[str, Measurement | Prepared], step_px: int = 1
) -> list[Path]:
    """Write `registered.ply` to the folder `out`: the largest group, in its world.

    Each further group of two or more measurements goes to a file `registered_group<id>.ply` of its own: groups have no
    common frame. Measurements are asked for one after the other; a mapping may read them then.

    Returns
    -------
    list of Path
        The files written, `registered.ply` first.
    """
    if step_px < 1:
        raise InputError("step_px", f"found {step_px}", "a whole number >= 1")
    members = {g.id: [m for m in registration.measurements if m.group == g.id] for g in registration.groups}
    order = sorted(members, key=lambda group: (-len(members[group]), group))
    references = {g.id: g.reference for g in registration.groups}
    indices = {m.name: index for index, m in enumerate(registration.measurements)}
    paths = []
    for position, group in enumerate(order):
        if position > 0 and len(members[group]) < 2:
            continue
        path = Path(out) / ("registered.ply" if position == 0 else f"registered_group{group}.ply")
        comments = [f"group {group}, world = sensor frame of {references[group]}"]
        comments += [f"measurement {indices[placed.name]} = {placed.name}" for placed in members[group]]

        def clouds(placed_ones: Sequence[PlacedMeasurement]) -> Iterator[NDArray[np.void]]:
            for placed in placed_ones:
                item = Prepared.of(measurements[placed.name])
                T, index = placed.T_world_measurement, indices[placed.name]
                yield cloud(item.measurement, T, index, item.surface, step_px)

        write_ply(path, clouds(members[group]), comments, len(members[group]) * _MOST_POINTS)
        paths.append(path)
    return paths


#: More points than any measurement has.
_MOST_POINTS = 10**9
