"""Calibration boards as they were made: printed, perhaps not to scale, glued on a sheet that is perhaps not flat.

The board's frame is that of `planish.sensing.capture.board`: x along the columns, y along the rows, z into the board.
The object frame of the simulator looks the other way: its origin is the middle of the points, z points to the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from planish.errors import InputError
from planish.geometry import Array, compose, exp_so3, invert, transform_points
from planish.sensing.capture.board import AsymmetricCircles, Board, Charuco, Chessboard, Circles, board_points
from planish.simulation.board_prints import charuco_cells, chessboard_cells, disc_radius_mm
from planish.simulation.printed import Print
from planish.simulation.surfaces import Cylinder, Plate, Surface

#: From the board's axes to the object's: x stays, y and z turn round.
_FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class PrintedBoard:
    """A board as it was made, which may differ from what its file says.

    Parameters
    ----------
    board : Board
        What the file says.
    scale : tuple of float
        True over stated pitch along x and y.
    sagitta_mm : float
        Height of the middle of the points over their border, measured across `bend_axis_deg`; > 0: the middle is
        nearer to the sensor. The sheet is part of a cylinder.
    bend_axis_deg : float
        Direction of the cylinder's axis in the board's xy plane, from x to y [deg].
    margin_mm : float, optional
        White margin around the print; default: half a pitch and at least 5 mm.
    ink : float
        Reflectance of the print over that of the sheet.
    light_discs : bool
        Of circle grids: light discs on dark ground.
    """

    board: Board
    scale: tuple[float, float] = (1.0, 1.0)
    sagitta_mm: float = 0.0
    bend_axis_deg: float = 90.0
    margin_mm: float | None = None
    ink: float = 0.06
    light_discs: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be made."""
        _require(0 < min(self.scale) <= max(self.scale) < np.inf, "scale", self.scale, "factors above 0")
        _require(self.margin_mm is None or self.margin_mm >= 0, "margin_mm", self.margin_mm, "at least 0 mm")
        _require(0 <= self.ink < 1, "ink", self.ink, "a share from 0 to below 1")
        _require(abs(self.bend_axis_deg) < np.inf, "bend_axis_deg", self.bend_axis_deg, "an angle [deg]")
        span = self._span_mm
        _require(abs(self.sagitta_mm) <= span / 8, "sagitta_mm", self.sagitta_mm, f"at most {span / 8:.3g} mm")
        self.printed  # noqa: B018 - what cannot be printed is refused now, not when it is rendered

    @cached_property
    def points_board(self) -> Array:
        """Where the points (N, 3) of `board_points` truly are [mm], in the board's frame.

        The frame of a bent board touches it in the middle of its points; that of a flat one has its origin in
        point (0, 0).
        """
        return self._in_board_frame(self._flat)

    @cached_property
    def normals_board(self) -> Array:
        """Unit normals (N, 3) of the sheet at the points, towards the sensor, in the board's frame."""
        x, _ = self._turned(self._flat)
        angle = np.zeros_like(x) if self.radius_mm is None else x / self.radius_mm
        normals = np.column_stack([np.sin(angle), np.zeros_like(x), np.cos(angle)])
        return np.asarray(normals @ self.T_object_board[:3, :3])

    @cached_property
    def outline_board(self) -> Array:
        """Corners and middles of the sides (8, 3) [mm] of the print, in the board's frame."""
        (x0, y0), (x1, y1) = self._outline_mm * self.scale
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        return self._in_board_frame(
            np.array([[x0, y0], [x, y0], [x1, y0], [x1, y], [x1, y1], [x, y1], [x0, y1], [x0, y]])
        )

    @cached_property
    def radius_mm(self) -> float | None:
        """Radius of the bent sheet [mm], negative where it is hollow; None where it is flat."""
        if self.sagitta_mm == 0:
            return None
        f, span = abs(self.sagitta_mm), self._span_mm
        # Arc 2 a r, sagitta r (1 - cos a); one Newton step from the parabola leaves (a/2)^4.
        a = 4 * f / span
        a -= ((1 - np.cos(a)) / (2 * a) - f / span) / (np.sin(a) / (2 * a) - (1 - np.cos(a)) / (2 * a * a))
        return float(np.copysign(span / (2 * a), self.sagitta_mm))

    @property
    def T_object_board(self) -> Array:
        """Maps the board's frame into the object frame of `surface` (4, 4) [mm]."""
        R = exp_so3([0, 0, self._turn]) @ _FLIP
        return compose(R, -R @ np.array([*self._middle, 0.0]))

    @property
    def surface(self) -> Surface:
        """The sheet: the outline of the print and its margin, with its sides along the bend."""
        (x0, y0), (x1, y1) = self._outline_mm
        corners = np.array([[x0, y0], [x1, y0], [x0, y1], [x1, y1]]) * self.scale
        half_s, half_t = np.abs(self._turned(corners)).max(1) + self._margin
        if self.radius_mm is None:
            return Plate(half_s=float(half_s), half_t=float(half_t))
        return Cylinder(half_s=float(half_s), half_t=float(half_t), radius=self.radius_mm)

    @cached_property
    def printed(self) -> Print:
        """The print on `surface`."""
        linear = np.linalg.inv(self._turn_surface * self.scale)
        middle = np.array(self._middle) / self.scale
        print_surface = np.column_stack([linear, middle])
        if isinstance(self.board, Chessboard):
            x, y, dark = chessboard_cells(self.board)
        elif isinstance(self.board, Charuco):
            x, y, dark = charuco_cells(self.board)
        else:
            (x0, y0), (x1, y1) = self._outline_mm
            centres = board_points(self.board)[:, :2]
            disc, ground = (1.0, self.ink) if self.light_discs else (self.ink, 1.0)
            radius = np.full((len(centres), 1), disc_radius_mm(self.board))
            discs = np.hstack([centres, radius, np.full_like(radius, disc)])
            edges = np.array([x0, x1]), np.array([y0, y1])
            return Print(*edges, np.array([[ground]]), discs, print_surface)
        return Print(x, y, np.where(dark, self.ink, 1.0), print_surface=print_surface)

    @property
    def _outline_mm(self) -> Array:
        """First and last corner of the print (2, 2), in stated millimetres."""
        points, pitch = board_points(self.board)[:, :2], np.array(self.board.pitches_mm)
        reach = pitch
        if isinstance(self.board, (Circles, AsymmetricCircles)):
            reach = np.maximum(pitch, 1.5 * disc_radius_mm(self.board))
        return np.stack([points.min(0) - reach, points.max(0) + reach])

    @property
    def _flat(self) -> Array:
        """True places (N, 2) of the points on the unrolled sheet [mm], from point (0, 0)."""
        return board_points(self.board)[:, :2] * self.scale

    @property
    def _middle(self) -> tuple[float, float]:
        x, y = (self._flat.min(0) + self._flat.max(0)) / 2
        return float(x), float(y)

    @property
    def _margin(self) -> float:
        return max(5.0, 0.5 * max(self.board.pitches_mm)) if self.margin_mm is None else self.margin_mm

    @property
    def _turn(self) -> float:
        """Turn that brings the bend's axis onto the object's y axis [rad]; none for a flat board."""
        return 0.0 if self.sagitta_mm == 0 else np.deg2rad(self.bend_axis_deg) - np.pi / 2

    @property
    def _turn_surface(self) -> Array:
        """From the board's x, y to surface coordinates (2, 2)."""
        return np.asarray((exp_so3([0, 0, self._turn]) @ _FLIP)[:2, :2])

    def _turned(self, flat: Array) -> Array:
        """Surface coordinates (2, N) of places (N, 2) on the unrolled sheet."""
        return np.asarray(self._turn_surface @ (flat - self._middle).T)

    def _in_board_frame(self, flat: Array) -> Array:
        """Points (N, 3) [mm] of the sheet from their places (N, 2) on the unrolled sheet."""
        x, y = self._turned(flat)
        z = np.zeros_like(x)
        if self.radius_mm is not None:
            angle = x / self.radius_mm
            x, z = self.radius_mm * np.sin(angle), self.radius_mm * (np.cos(angle) - 1)
        return np.asarray(transform_points(invert(self.T_object_board), np.column_stack([x, y, z])), float)

    @property
    def _span_mm(self) -> float:
        axis = np.deg2rad(self.bend_axis_deg)
        return float(np.ptp(self._flat @ [np.sin(axis), -np.cos(axis)]))


def _require(condition: bool, subject: str, found: object, expected: str) -> None:
    if not condition:
        raise InputError(f"printed board: {subject}", f"found {found}", expected)
