"""Where an operator holds a board, and where its points are seen there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.geometry import Array, compose, exp_so3, transform_points
from planish.rig import Camera, Rig
from planish.simulation.boards import PrintedBoard

#: Turns of the board about its normal [deg], one after the other; a hand adds up to ROLL_JITTER_DEG.
ROLLS_DEG = (0.0, 0.0, 90.0, 0.0, 180.0, 0.0, -90.0)
ROLL_JITTER_DEG = 12.0
#: Share of the image's height that the board's diagonal fills where the axes of the devices do not meet.
FILLED = 0.7
#: Smallest eigenvalue of the crossing's normal matrix per device: below 2 degrees between the axes they do not meet.
SMALLEST_CROSSING = 6e-4
#: Places drawn for each one wanted, at most, and those of them that are compared.
DRAWN, COMPARED = 400, 24
#: Places drawn at a time.
BATCH = 40
#: Cells (columns, rows) of an image whose coverage counts.
COVERAGE_CELLS = (8, 6)


@dataclass(frozen=True)
class SeenPoints:
    """Where a device has the points of the board: `pixel_px` (N, 2) [px] and `inside` (N,), those in its image."""

    pixel_px: Array
    inside: NDArray[np.bool_]


def see_board(rig: Rig, board: PrintedBoard, T_sensor_board: Array, border_px: float = 0.0) -> dict[str, SeenPoints]:
    """Return per device of the rig ("A", "B", "projector") where its true image of the board's points is.

    `inside` leaves out what is nearer than `border_px` to the image's border.
    """
    points = np.asarray(transform_points(T_sensor_board, board.points_board), float)
    return {name: _seen(device, points, border_px) for name, device in rig.devices.items()}


def _seen(device: Camera, points_sensor: Array, border_px: float) -> SeenPoints:
    pixels = device.project(points_sensor)
    last = np.array(device.size_px) - 0.5 - border_px
    with np.errstate(invalid="ignore"):
        return SeenPoints(pixels, np.asarray(((pixels >= border_px - 0.5) & (pixels <= last)).all(-1)))


def board_places(
    rig: Rig, board: PrintedBoard, count: int, seed: int = 0, *, tilt_deg: float = 35.0,
    depth: tuple[float, float] = (0.85, 1.15), devices: Sequence[str] | None = None, seen_share: float = 1.0,
    border_px: float = 6.0,
) -> list[Array]:  # fmt: skip
    """Return `count` places T_sensor_board (4, 4) that a sensible operator would choose.

    The board is tilted by up to `tilt_deg` about all directions, turned by 90 and 180 degrees at times, held at `depth`
    (from, to) times the working distance, and moved to where the images have not been covered yet.

    Parameters
    ----------
    rig : Rig
        The sensor.
    board : PrintedBoard
        What is held.
    count : int
        Number of places.
    seed : int
        Everything random follows from it.
    tilt_deg, depth
        As above.
    devices : sequence of str, optional
        The devices that must see the board; default: the cameras.
    seen_share : float
        Share of the points that each of them must see, `border_px` away from its image's border; with 1, the outline of
        the print as well.
    border_px : float
        See there.

    Raises
    ------
    InputError
        Where the board does not fit into the images, or a value has no meaning.
    """
    _require(count >= 1, "count", count, "a whole number >= 1")
    _require(0 <= tilt_deg < 80, "tilt_deg", tilt_deg, "0 to below 80 degrees")
    _require(0 < depth[0] <= depth[1], "depth", depth, "(from, to), factors above 0")
    _require(0 < seen_share <= 1, "seen_share", seen_share, "a share above 0, up to 1")
    names = tuple(rig.cameras) if devices is None else tuple(devices)
    _require(set(names) <= set(rig.devices) and bool(names), "devices", names, f"some of {', '.join(rig.devices)}")
    drawing = _Drawing(rig, board, names, np.random.Generator(np.random.Philox(key=[seed, 40])))
    covered = {name: np.ones(COVERAGE_CELLS[::-1]) for name in names}
    # Detectors of whole boards want to see what surrounds the outermost points.
    wanted = board.points_board if seen_share < 1 else np.vstack([board.points_board, board.outline_board])
    places: list[Array] = []
    left = DRAWN * count // BATCH
    while len(places) < count:
        fitting: list[tuple[Array, dict[str, Array]]] = []
        while len(fitting) < COMPARED and left > 0:
            left -= 1
            drawn = drawing.places(ROLLS_DEG[len(places) % len(ROLLS_DEG)], tilt_deg, depth)
            points = drawn[:, None, :3, :3] @ wanted[:, :, None]
            points_sensor = points[..., 0] + drawn[:, None, :3, 3]
            seen = {name: _seen(rig.devices[name], points_sensor, border_px) for name in names}
            fits = np.all([view.inside.mean(1) >= seen_share for view in seen.values()], axis=0)
            for k in np.flatnonzero(fits):
                pixels = {name: view.pixel_px[k][view.inside[k]] for name, view in seen.items()}
                fitting.append((drawn[k], {name: _cells(rig.devices[name], p) for name, p in pixels.items()}))
        if not fitting:
            raise InputError(
                "board", f"fits into the images of {', '.join(names)} at {len(places)} of {count} places",
                "a smaller board, another 'depth', or a smaller 'seen_share'",
            )  # fmt: skip
        # The one that adds most to what is covered.
        T, cells = max(fitting, key=lambda item: sum(float((n / covered[d]).sum()) for d, n in item[1].items()))
        places.append(T)
        for name, numbers in cells.items():
            covered[name] += numbers
    return places


def _cells(device: Camera, pixels: Array) -> Array:
    """Return the number of pixels (N, 2) per cell of the image (rows, columns)."""
    columns, rows = COVERAGE_CELLS
    width, height = device.size_px
    column, row = (pixels + 0.5).T * [[columns / width], [rows / height]]
    cell = np.clip(row, 0, rows - 1).astype(int) * columns + np.clip(column, 0, columns - 1).astype(int)
    return np.bincount(cell, minlength=rows * columns).reshape(rows, columns).astype(float)


class _Drawing:
    """Draws places at random, around where the devices look."""

    def __init__(self, rig: Rig, board: PrintedBoard, names: Sequence[str], rng: np.random.Generator) -> None:
        self.rng = rng
        self.seen_by = [rig.devices[name] for name in names]
        self.middle = (board.points_board.min(0) + board.points_board.max(0)) / 2
        axes = np.array([device.T_camera_sensor[2, :3] for device in self.seen_by])
        centers = np.array([device.center_sensor for device in self.seen_by])
        z = axes.mean(0) / np.linalg.norm(axes.mean(0))
        across = self.seen_by[0].T_camera_sensor[0, :3]
        x = across - (across @ z) * z
        x /= np.linalg.norm(x)
        self.R_sensor_view = np.column_stack([x, np.cross(z, x), z])
        self.eye = centers.mean(0)
        device = self.seen_by[0]
        diagonal = float(np.linalg.norm(np.ptp(board.points_board, axis=0)))
        filling = float(device.K[1, 1]) * diagonal / (FILLED * device.size_px[1])
        self.distance_mm = _crossing_distance(centers, axes, z) or filling

    def places(self, roll_deg: float, tilt_deg: float, depth: tuple[float, float]) -> Array:
        """Return T_sensor_board (BATCH, 4, 4) of a board turned by about `roll_deg`."""
        rng, z = self.rng, self.R_sensor_view[:, 2]
        device = self.seen_by[rng.integers(len(self.seen_by))]
        rays = device.rays_sensor(rng.uniform([0, 0], device.size_px, (BATCH, 2)))
        distance = self.distance_mm * rng.uniform(*depth, BATCH)
        targets = (
            device.center_sensor + rays * (((self.eye - device.center_sensor) @ z + distance) / (rays @ z))[:, None]
        )
        # As many tilts as their solid angle has room: large ones carry the principal distances.
        tilt = np.deg2rad(tilt_deg) * np.sqrt(rng.uniform(size=BATCH))
        around = rng.uniform(0, 2 * np.pi, BATCH)
        roll = np.deg2rad(roll_deg + rng.uniform(-ROLL_JITTER_DEG, ROLL_JITTER_DEG, BATCH))
        out = np.empty((BATCH, 4, 4))
        for k in range(BATCH):
            tilted = exp_so3(tilt[k] * np.array([np.cos(around[k]), np.sin(around[k]), 0]))
            R = self.R_sensor_view @ tilted @ exp_so3([0, 0, roll[k]])
            out[k] = compose(R, targets[k] - R @ self.middle)
        return out


def _crossing_distance(centers: Array, axes: Array, z: Array) -> float | None:
    """Distance along z from the middle of the centres to where the axes meet; None where they do not."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    if np.linalg.eigvalsh(normal)[0] < SMALLEST_CROSSING * len(axes):
        return None
    distance = float((np.linalg.solve(normal, (across @ centers[:, :, None]).sum(0)[:, 0]) - centers.mean(0)) @ z)
    return distance if distance > 0 else None


def _require(condition: bool, subject: str, found: object, expected: str) -> None:
    if not condition:
        raise InputError(f"board places: {subject}", f"found {found}", expected)
