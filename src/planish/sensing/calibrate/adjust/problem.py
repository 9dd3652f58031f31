"""The adjustment's problem in arrays: what was seen, what is free, and how the residuals change with it.

All arrays of a device are padded: row v is a view, column i a point of the board; what was not seen has infinite sigma.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.rig import Camera, Rig
from planish.rig.parameters import DEVICE_PARAMETERS, DISTORTION, EXTERNAL_PART, PROJECTOR
from planish.sensing.calibrate.observations import BoardObservations, Index
from planish.sensing.capture.board import AsymmetricCircles, Circles, board_points

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Block:
    """What one device saw of the board in all views; the projector through one of the cameras.

    Parameters
    ----------
    device, through : str, str or None
        Device, and the camera through whose image the projector's code was read.
    observed_px : ndarray (V, N, 2)
        Observed positions [px]; the projector's at `camera_px`.
    sigma_px : ndarray (V, N)
        Their stated standard deviation [px]; infinite where not seen.
    camera_px, jacobian : ndarray (V, N, 2), (V, N, 2, 2) or None
        Of `CodedPoints`.
    """

    device: str
    through: str | None
    observed_px: Array
    sigma_px: Array
    camera_px: Array | None = None
    jacobian: Array | None = None

    @property
    def seen(self) -> Mask:
        """Which points were seen (V, N)."""
        return np.isfinite(self.sigma_px)

    @property
    def views(self) -> Mask:
        """Views (V,) in which the device sees the board."""
        return np.asarray(self.seen.any(1), np.bool_)

    @property
    def devices(self) -> tuple[str, ...]:
        """Devices whose parameters the residuals depend on."""
        return (self.device,) if self.through is None else (self.device, self.through)

    def without(self, unseen: Mask) -> Block:
        """Return the block without the points of a mask that broadcasts to (V, N)."""
        return replace(self, sigma_px=np.where(unseen, np.inf, self.sigma_px))


@dataclass(frozen=True)
class Pseudo:
    """Pseudo-observation: a weighted sum of one device's parameters, with its value and standard deviation."""

    device: str
    weights: Mapping[str, float]
    value: float
    sigma: float

    def row(self, free: Free) -> Array:
        """Derivative (C,) by the free parameters."""
        row = np.zeros(free.size)
        for name, weight in self.weights.items():
            row[free.columns(self.device)[free.places[self.device].index(DEVICE_PARAMETERS.index(name))]] = weight
        return row

    def residual(self, camera: Camera) -> float:
        """Return value less adjusted sum."""
        K = camera.K
        own = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        own.update(zip(DISTORTION, camera.distortion, strict=True))
        return self.value - sum(weight * own[name] for name, weight in self.weights.items())


@dataclass(frozen=True)
class Problem:
    """Blocks of all devices over the same views, and the board they see.

    Parameters
    ----------
    points_board : ndarray (N, 3)
        Points of the board [mm].
    views : tuple of str
        Names of the views.
    blocks : tuple of Block
        What was seen.
    pseudo : tuple of Pseudo
        Weak knowledge of the devices, where the boards do not tell enough.
    modes : ndarray (k, N, 3)
        Shapes that the board may have besides [mm per unit of amplitude].
    disc_radius_mm : float or None
        Where the points are the images of discs.
    """

    points_board: Array
    views: tuple[str, ...]
    blocks: tuple[Block, ...]
    pseudo: tuple[Pseudo, ...] = ()
    modes: Array = field(default_factory=lambda: np.empty((0, 0, 3)))
    disc_radius_mm: float | None = None

    @property
    def devices(self) -> tuple[str, ...]:
        """Devices with observations, in the order of the rig."""
        return tuple(sorted({block.device for block in self.blocks}, key=lambda name: (name == PROJECTOR, name)))

    @property
    def center(self) -> Array:
        """Middle (3,) of the board's points [mm]."""
        return self.points_board.mean(0)

    @property
    def covered(self) -> Mask:
        """Views (V,) in which some device still sees the board."""
        return np.any([block.views for block in self.blocks], axis=0)

    def blocks_of(self, device: str) -> tuple[Block, ...]:
        """Return the blocks of one device: one of a camera, one or two of the projector."""
        return tuple(block for block in self.blocks if block.device == device)

    def seen_by(self, device: str) -> Mask:
        """Return the views (V,) in which a device sees the board."""
        return np.any([block.views for block in self.blocks_of(device)], axis=0)

    def only(self, views: Mask) -> Problem:
        """Return the problem whose other views saw nothing."""
        return replace(self, blocks=tuple(block.without(~views[:, None]) for block in self.blocks))


@dataclass(frozen=True)
class State:
    """Values of everything that is adjusted.

    Parameters
    ----------
    devices : dict of Camera
        By name; the sensor frame is that of the reference device.
    T_sensor_board : ndarray (V, 4, 4)
        Place of the board per view [mm].
    amplitudes : ndarray (k,)
        Of the problem's modes.
    """

    devices: Mapping[str, Camera]
    T_sensor_board: Array
    amplitudes: Array

    @property
    def rig(self) -> Rig:
        """The devices as a rig."""
        cameras = {name: item for name, item in self.devices.items() if name != PROJECTOR}
        return Rig(cameras, self.devices.get(PROJECTOR))


@dataclass(frozen=True)
class Free:
    """Which parameters are free: per device, places in DEVICE_PARAMETERS (the reference: internal ones only).

    The vector of the adjustment holds the devices in their order, then the amplitudes of `modes` shapes of the board.
    """

    places: Mapping[str, tuple[int, ...]]
    modes: int = 0

    @classmethod
    def of(cls, coefficients: Mapping[str, Sequence[str]], reference: str, modes: int = 0) -> Free:
        """Return fx fy cx cy, the named coefficients and, but for the reference, the external parameters."""
        places = {}
        for device, names in coefficients.items():
            own = [DEVICE_PARAMETERS.index(name) for name in ("fx", "fy", "cx", "cy", *names)]
            external = range(EXTERNAL_PART.start, EXTERNAL_PART.stop) if device != reference else ()
            places[device] = (*sorted(own), *external)
        return cls(places, modes)

    def columns(self, device: str) -> Index:
        """Return where a device's parameters stand in the vector (n,) int."""
        start = 0
        for name, places in self.places.items():
            if name == device:
                return np.arange(start, start + len(places))
            start += len(places)
        raise KeyError(device)

    @property
    def mode_columns(self) -> Index:
        """Where the amplitudes stand (k,) int."""
        return np.arange(self.size - self.modes, self.size)

    @property
    def size(self) -> int:
        """Number of free parameters beside the places of the board."""
        return sum(map(len, self.places.values())) + self.modes

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the devices' parameters, in the order of the vector."""
        return tuple(f"{name}.{DEVICE_PARAMETERS[place]}" for name, places in self.places.items() for place in places)


def placed(T_sensor_board: Array) -> Mask:
    """Return in which views (V,) the place (4, 4) of the board is known."""
    return np.asarray(np.isfinite(T_sensor_board).all((1, 2)), np.bool_)


def problem_of(observations: BoardObservations) -> Problem:
    """Return the observations in arrays."""
    points, shape = board_points(observations.board), (len(observations.views), len(board_points(observations.board)))
    blocks = []
    for device in sorted(observations.size_px):
        observed, sigma = np.zeros((*shape, 2)), np.full(shape, np.inf)
        for v, view in enumerate(observations.views):
            if (seen := view.cameras.get(device)) is not None:
                observed[v, seen.index], sigma[v, seen.index] = seen.pixel_px, seen.sigma_px
        blocks.append(Block(device, None, observed, sigma))
    for through in sorted(observations.size_px) if observations.projector_px is not None else ():
        observed, sigma = np.zeros((*shape, 2)), np.full(shape, np.inf)
        camera, jacobian = np.zeros((*shape, 2)), np.zeros((*shape, 2, 2))
        for v, view in enumerate(observations.views):
            for code in (code for code in view.code if code.camera == through):
                observed[v, code.index], sigma[v, code.index] = code.position_px, code.sigma_px
                camera[v, code.index], jacobian[v, code.index] = code.camera_px, code.jacobian
        if np.isfinite(sigma).any():
            blocks.append(Block(PROJECTOR, through, observed, sigma, camera, jacobian))
    radius = None
    if isinstance(observations.board, Circles | AsymmetricCircles) and observations.board.diameter_mm is not None:
        radius = observations.board.diameter_mm / 2
    return Problem(points, tuple(view.name for view in observations.views), tuple(blocks), disc_radius_mm=radius)
