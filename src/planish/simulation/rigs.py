"""Rigs with the covariance that a calibration would give them, and rigs that differ from it as it says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from planish.errors import InputError
from planish.geometry import Array, transform_points
from planish.rig import Rig
from planish.rig.derivatives import project_with_derivatives
from planish.rig.parameters import EXTERNAL, selection
from planish.simulation.board_places import see_board
from planish.simulation.boards import PrintedBoard

#: Intrinsic parameters of each device that a calibration estimates.
USUAL_INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def draw_rig(rig: Rig, seed: int) -> Rig:
    """Return the rig with its parameters drawn from its covariance (Gaussian, about its values).

    Raises
    ------
    InputError
        Where the rig has no covariance.
    """
    if rig.covariance is None:
        raise InputError("rig", "has no covariance", "a rig whose calibration states one")
    modes = rig.modes()
    rng = np.random.Generator(np.random.Philox(key=[seed, 50]))
    return rig.changed(rng.standard_normal(len(modes)) @ modes)


def with_expected_covariance(
    rig: Rig, board: PrintedBoard, places: Sequence[Array], noise_px: float = 0.05,
    intrinsics: Sequence[str] = USUAL_INTRINSICS, pitch_sigma: float = 0.0,
) -> Rig:  # fmt: skip
    """Return the rig in camera A's frame with the covariance of a least-squares calibration by a board.

    Parameters
    ----------
    rig : Rig
        True rig, in any frame.
    board : PrintedBoard
        The board, exactly known.
    places : sequence of ndarray (4, 4)
        T_sensor_board per view; each device sees those points that lie in its image.
    noise_px : float
        Standard deviation of each coordinate of each point in each device [px].
    intrinsics : sequence of str
        Parameters of each device that are estimated, apart from where the devices are.
    pitch_sigma : float
        Relative standard deviation of the board's uniform scale, which moves the devices apart or together.

    Raises
    ------
    InputError
        Where the places do not determine the parameters.

    Notes
    -----
    The inverse of the information of the rig's parameters, those of each view's place eliminated by their Schur
    complement (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6.1).
    """
    T_A_sensor = rig.cameras["A"].T_camera_sensor
    rig = rig.in_frame_of("A")
    names = tuple(
        f"{device}.{name}" for device in rig.devices for name in (*intrinsics, *(EXTERNAL if device != "A" else ()))
    )
    picks = selection(names, tuple(rig.devices))
    information = np.zeros((len(names), len(names)))
    for T in places:
        T_A_board = T_A_sensor @ T
        points = np.asarray(transform_points(T_A_board, board.points_board), float)
        by_rig, by_place = [], []
        for device, seen in see_board(rig, board, T_A_board).items():
            x = points[seen.inside]
            _, by_point, by_parameter = project_with_derivatives(rig.devices[device], x)
            by_rig.append((by_parameter @ picks[device]).reshape(-1, len(names)))
            by_place.append(np.concatenate([np.cross(x[:, None], by_point), by_point], axis=2).reshape(-1, 6))
        J, P = np.concatenate(by_rig) / noise_px, np.concatenate(by_place) / noise_px
        between = P.T @ J
        information += J.T @ J - between.T @ np.linalg.lstsq(P.T @ P, between, rcond=None)[0]
    covariance = _inverse(information)
    # Scale alone: all translations grow by the same share.
    growth = np.zeros(len(names))
    for device, item in rig.devices.items():
        for axis, value in zip("xyz", item.T_camera_sensor[:3, 3], strict=True):
            if (name := f"{device}.translation_{axis}") in names:
                growth[names.index(name)] = pitch_sigma * value
    return replace(rig, covariance=covariance + np.outer(growth, growth), covariance_parameters=names)


def _inverse(information: Array) -> Array:
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        raise InputError("places", "leave parameters of the rig open", "views that every device sees")
    scaled = information / np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < np.finfo(float).eps * len(scaled) * 1e3:
        raise InputError("places", "leave parameters of the rig open", "more views, tilted about several directions")
    return np.linalg.inv(scaled) / np.outer(scale, scale)
