"""How the devices lie to each other: one orientation for all views, and the views that contradict it.

A board can be numbered in more than one way, and an image can be saved upside down. Both show only in the contradiction
of two devices: each view proposes an orientation, and what fits most views counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from planish.geometry import Array, invert
from planish.measurement import Finding
from planish.rig import Camera
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.problem import Block, Problem
from planish.sensing.calibrate.adjust.start import place_boards
from planish.sensing.calibrate.adjust.symmetry import Turn

#: A view fits where the other device's image of the board is predicted within this share of the image's width ...
FIT_SHARE = 0.01
#: ... or within so many times the median of the views that do.
FIT_TIMES = 5.0
#: So many points of the board serve for the search.
SEARCH_POINTS = 16
#: So many views at most propose an orientation.
PROPOSING_VIEWS = 60


@dataclass(frozen=True)
class Oriented:
    """A device in the sensor frame, with what became of the observations on the way.

    Parameters
    ----------
    problem : Problem
        With boards numbered alike, and without contradicting images.
    camera : Camera
        The device in the sensor frame.
    T_sensor_board : ndarray (V, 4, 4)
        Places of the board, now those that only this device sees as well; NaN where none.
    findings : tuple of Finding
        Images that were left out or numbered anew.
    """

    problem: Problem
    camera: Camera
    T_sensor_board: Array
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class _Pair:
    """One device against the boards as the other devices have placed them."""

    problem: Problem
    block: Block
    camera: Camera
    devices: Mapping[str, Camera]
    T_sensor_board: Array
    T_device_board: Array
    turns: tuple[Turn, ...]
    images: tuple[Mapping[str, str], ...]

    @property
    def shared(self) -> Array:
        placed = np.isfinite(self.T_sensor_board).all((1, 2)) & np.isfinite(self.T_device_board).all((1, 2))
        return np.flatnonzero(placed & self.block.seen.any(1))

    def errors(self, T_device_sensor: Array, view: int, T_sensor_board: Array, observed_px: Array) -> Array:
        """Median error [px] of the predicted image of the board, per turn of its numbering."""
        seen = np.flatnonzero(self.block.seen[view])
        seen = seen[:: max(1, len(seen) // SEARCH_POINTS)]
        T = np.stack([T_device_sensor @ T_sensor_board @ turn.T_board_board for turn in self.turns])
        points = self.problem.points_board[seen] @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
        own = replace(self.camera, T_camera_sensor=np.eye(4))
        away = np.linalg.norm(own.project(points) - observed_px[seen], axis=-1)
        return np.median(np.nan_to_num(away, nan=1e9), axis=1)


def orient(
    problem: Problem,
    block: Block,
    camera: Camera,
    devices: Mapping[str, Camera],
    T_sensor_board: Array,
    turns: tuple[Turn, ...],
    images: tuple[Mapping[str, str], ...],
) -> Oriented:
    """Return a device in the sensor frame.

    Parameters
    ----------
    problem : Problem
        All observations.
    block : Block
        What the device saw, as positions of its own.
    camera : Camera
        Its calibration in its own frame.
    devices : mapping of Camera
        Devices that are already placed.
    T_sensor_board : ndarray (V, 4, 4)
        Places of the board by them; NaN where none of them sees it.
    turns : tuple of Turn
        Numberings of the board; a projector has that of its camera.
    images : tuple of mappings
        Per view, names of the cameras' images.
    """
    own = place_boards(block, problem.points_board, camera, block.seen.any(1))
    turns = turns[:1] if block.device == PROJECTOR else turns
    pair = _Pair(problem, block, camera, devices, T_sensor_board, own, turns, images)
    best, least = np.eye(4), np.inf
    tolerance = FIT_SHARE * camera.size_px[0]
    proposing = pair.shared[:: max(1, -(-len(pair.shared) // PROPOSING_VIEWS))]
    for v in proposing:
        for turn in turns:
            T = own[v] @ invert(T_sensor_board[v] @ turn.T_board_board)
            error = [pair.errors(T, w, T_sensor_board[w], block.observed_px[w]).min() for w in pair.shared]
            score = float(np.log1p((np.array(error) / tolerance) ** 2).sum())
            if score < least:
                best, least = T, score
    return _apply(pair, best)


def _apply(pair: _Pair, T_device_sensor: Array) -> Oriented:
    """Number the boards alike, leave out what contradicts, place the boards that only this device sees."""
    errors = {
        v: pair.errors(T_device_sensor, v, pair.T_sensor_board[v], pair.block.observed_px[v]) for v in pair.shared
    }
    smallest = np.array([error.min() for error in errors.values()])
    limit = max(FIT_SHARE * pair.camera.size_px[0], FIT_TIMES * float(np.median(smallest)))
    problem, findings = pair.problem, []
    places = pair.T_sensor_board.copy()
    for v, error in errors.items():
        if error.min() > limit:
            blamed, finding = _explain(pair, T_device_sensor, v, limit)
            problem = without_images(problem, v, blamed)
            findings.append(finding)
        elif (turn := pair.turns[int(error.argmin())]).quarters:
            problem = _renumbered(problem, pair.block.device, v, turn)
            findings.append(_turned_labels(pair, v, turn))
    T_sensor_device = invert(T_device_sensor)
    for v in np.flatnonzero(~np.isfinite(places).all((1, 2)) & np.isfinite(pair.T_device_board).all((1, 2))):
        places[v] = T_sensor_device @ pair.T_device_board[v]
    return Oriented(problem, replace(pair.camera, T_camera_sensor=T_device_sensor), places, tuple(findings))


def _explain(pair: _Pair, T_device_sensor: Array, view: int, limit: float) -> tuple[tuple[str, ...], Finding]:
    """Which images of a contradicting view are to blame: one that is saved upside down, or all."""
    name, block = pair.problem.views[view], pair.block
    candidates: dict[str, float] = {}
    if block.device != PROJECTOR:
        turned = _upside_down(block, pair.camera)
        error = pair.errors(T_device_sensor, view, pair.T_sensor_board[view], turned.observed_px[view])
        candidates[block.device] = float(error.min())
    for device, camera in pair.devices.items():
        for other in pair.problem.blocks_of(device):
            if other.through is None and other.seen[view].any():
                turned = _upside_down(other, camera)
                only = np.arange(len(pair.problem.views)) == view
                T = invert(camera.T_camera_sensor) @ place_boards(turned, pair.problem.points_board, camera, only)[view]
                if np.isfinite(T).all():
                    candidates[device] = float(pair.errors(T_device_sensor, view, T, block.observed_px[view]).min())
    device = min(candidates, key=lambda key: candidates[key], default="")
    if device and candidates[device] <= limit:
        image = pair.images[view].get(device, device)
        told = f"view {name}: image {image} does not fit; it would if it were turned by 180 degrees"
        return (device,), Finding(
            f"image {image}", 180.0, None, "deg", told, f"{told}; it is left out: save it as the camera sees it"
        )
    what = "the projector's code" if block.device == PROJECTOR else f"{', '.join(pair.images[view].values())}"
    told = f"view {name}: {what} contradicts the orientation of the devices that the other views agree on"
    blamed = (PROJECTOR,) if block.device == PROJECTOR else tuple(sorted(pair.images[view]))
    return blamed, Finding(
        f"view {name}", None, None, "", told, f"{told}; it is left out: did the board move between the images?"
    )


def _upside_down(block: Block, camera: Camera) -> Block:
    return replace(block, observed_px=np.array(camera.size_px) - 1.0 - block.observed_px)


def without_images(problem: Problem, view: int, devices: tuple[str, ...]) -> Problem:
    """Return the problem without these devices' images of a view, and without what was decoded through them."""
    only = np.arange(len(problem.views))[:, None] == view
    blocks = tuple(
        block.without(only) if block.device in devices or block.through in devices else block
        for block in problem.blocks
    )
    return replace(problem, blocks=blocks)


def _renumbered(problem: Problem, device: str, view: int, turn: Turn) -> Problem:
    blocks = []
    for block in problem.blocks:
        if device in (block.device, block.through):
            changed = {}
            for field in ("observed_px", "sigma_px", "camera_px", "jacobian"):
                if (values := getattr(block, field)) is not None:
                    values = values.copy()
                    values[view, turn.becomes] = getattr(block, field)[view]
                    changed[field] = values
            block = replace(block, **changed)
        blocks.append(block)
    return replace(problem, blocks=tuple(blocks))


def _turned_labels(pair: _Pair, view: int, turn: Turn) -> Finding:
    image = pair.images[view].get(pair.block.device, pair.block.device)
    told = "the board looks alike when turned; the other views tell how its points are numbered here"
    return Finding(f"numbering of the board in {image}", 90.0 * turn.quarters, None, "deg", told)
