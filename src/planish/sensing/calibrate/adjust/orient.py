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
from planish.sensing.calibrate.adjust.problem import Block, Problem, placed
from planish.sensing.calibrate.adjust.start import place_boards, upside_down
from planish.sensing.calibrate.observations import Index
from planish.sensing.calibrate.symmetry import Turn

#: A view fits where the other device's image of the board is predicted within this share of the image's width ...
FIT_SHARE = 0.01
#: ... or within so many times the median of the views that do.
FIT_TIMES = 5.0
#: So many points of the board serve for the search.
SEARCH_POINTS = 16
#: Error of a point that is predicted behind the device [px].
BEHIND_PX = 1e6
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
    def shared(self) -> Index:
        known = placed(self.T_sensor_board) & placed(self.T_device_board)
        return np.flatnonzero(known & self.block.views)

    def errors(
        self, T_device_sensor: Array, views: Index, T_sensor_board: Array, observed_px: Array | None = None
    ) -> Array:
        """Median error [px] of the predicted images of the board (n, turns), per turn of its numbering."""
        observed = self.block.observed_px if observed_px is None else observed_px
        turned = np.stack([turn.T_board_board for turn in self.turns])
        T = (T_device_sensor @ T_sensor_board)[:, None] @ turned
        index = np.stack([_some(np.flatnonzero(self.block.seen[v])) for v in views])
        points = self.problem.points_board[index][:, None] @ T[..., :3, :3].swapaxes(-1, -2) + T[..., None, :3, 3]
        own = replace(self.camera, T_camera_sensor=np.eye(4))
        away = np.linalg.norm(own.project(points) - observed[views[:, None], index][:, None], axis=-1)
        return np.asarray(np.median(np.nan_to_num(away, nan=BEHIND_PX), axis=-1))


def _some(seen: Index) -> Index:
    """SEARCH_POINTS of the seen points, evenly."""
    return seen[np.linspace(0, len(seen) - 1, SEARCH_POINTS).round().astype(int)]


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
    own = place_boards(block, problem.points_board, camera, block.views)
    turns = turns[:1] if block.device == PROJECTOR else turns
    pair = _Pair(problem, block, camera, devices, T_sensor_board, own, turns, images)
    best, least = np.eye(4), np.inf
    tolerance = FIT_SHARE * camera.size_px[0]
    shared = pair.shared
    proposing = shared[:: max(1, -(-len(shared) // PROPOSING_VIEWS))]
    for v in proposing:
        for turn in turns:
            T = own[v] @ invert(T_sensor_board[v] @ turn.T_board_board)
            error = pair.errors(T, shared, T_sensor_board[shared]).min(1)
            score = float(np.log1p((error / tolerance) ** 2).sum())
            if score < least:
                best, least = T, score
    return _apply(pair, best)


def _apply(pair: _Pair, T_device_sensor: Array) -> Oriented:
    """Number the boards alike, leave out what contradicts, place the boards that only this device sees."""
    errors = pair.errors(T_device_sensor, pair.shared, pair.T_sensor_board[pair.shared])
    limit = max(FIT_SHARE * pair.camera.size_px[0], FIT_TIMES * float(np.median(errors.min(1))))
    problem, findings = pair.problem, []
    places = pair.T_sensor_board.copy()
    for v, error in zip(pair.shared, errors, strict=True):
        if error.min() > limit:
            blamed, finding = _explain(pair, T_device_sensor, v, limit)
            problem = without_images(problem, v, blamed)
            findings.append(finding)
            if pair.block.device not in blamed:
                places[v] = np.nan
        elif (turn := pair.turns[int(error.argmin())]).quarters:
            problem = _renumbered(problem, pair.block.device, v, turn)
            findings.append(_turned_labels(pair, v, turn))
    unplaced = ~placed(places) & placed(pair.T_device_board)
    places[unplaced] = invert(T_device_sensor) @ pair.T_device_board[unplaced]
    return Oriented(problem, replace(pair.camera, T_camera_sensor=T_device_sensor), places, tuple(findings))


def _explain(pair: _Pair, T_device_sensor: Array, view: int, limit: float) -> tuple[tuple[str, ...], Finding]:
    """Which images of a contradicting view are to blame: one that is saved upside down, or all."""
    name, block, only = pair.problem.views[view], pair.block, np.array([view])
    candidates: dict[str, float] = {}
    if block.device != PROJECTOR:
        turned = upside_down(block, pair.camera)
        error = pair.errors(T_device_sensor, only, pair.T_sensor_board[only], turned.observed_px)
        candidates[block.device] = float(error.min())
    for device, camera in pair.devices.items():
        for other in pair.problem.blocks_of(device):
            if other.through is None and other.seen[view].any():
                turned = upside_down(other, camera)
                here = np.arange(len(pair.problem.views)) == view
                T = invert(camera.T_camera_sensor) @ place_boards(turned, pair.problem.points_board, camera, here)[only]
                if np.isfinite(T).all():
                    candidates[device] = float(pair.errors(T_device_sensor, only, T).min())
    device = min(candidates, key=lambda key: candidates[key], default="")
    if device and candidates[device] <= limit:
        image = pair.images[view].get(device, device)
        return (device,), upside_down_image(name, image)
    what = "the projector's code" if block.device == PROJECTOR else f"{', '.join(pair.images[view].values())}"
    told = f"view {name}: {what} contradicts the orientation of the devices that the other views agree on"
    blamed = (PROJECTOR,) if block.device == PROJECTOR else tuple(sorted(pair.images[view]))
    return blamed, Finding(
        f"view {name}", None, None, "", told, f"{told}; it is left out: did the board move between the images?"
    )


def upside_down_image(view: str, image: str) -> Finding:
    """Return the finding that an image was saved upside down."""
    told = f"view {view}: image {image} does not fit; it would if it were turned by 180 degrees"
    return Finding(f"image {image}", 180.0, None, "deg", told, f"{told}; it is left out: save it as the camera sees it")


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
