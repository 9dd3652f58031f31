"""Do the views hold the parameters at all? Errors where they cannot, findings where they hardly do."""

from __future__ import annotations

import numpy as np

from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Finding
from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.adjust.lens_models import FEW_VIEWS
from planish.sensing.calibrate.adjust.problem import Problem
from planish.sensing.calibrate.adjust.robust import Adjusted

#: Two views determine a focal length without saying how well; three do.
LEAST_VIEWS = 3
#: Boards within this angle [deg] are parallel; below the second one their tilts hold the focal length badly.
PARALLEL_DEG, WEAK_DEG = 3.0, 10.0
#: Relative standard deviation of a focal length that is no result, and one that deserves a warning.
UNDETERMINED, WEAK = 0.05, 0.005
ADVICE = "tilt them by 20 to 40 degrees in different directions"


def words(device: str) -> str:
    """Return a device's name in a sentence."""
    return "the projector" if device == PROJECTOR else f"camera {device}"


def require_views(problem: Problem, devices: tuple[str, ...]) -> None:
    """Refuse devices that too few views show.

    Raises
    ------
    InputError
        Naming the device and the number of its views.
    """
    for device in devices:
        count = int(problem.seen_by(device).sum()) if problem.blocks_of(device) else 0
        if count < LEAST_VIEWS:
            raise InputError(
                f"boards of {words(device)}", f"found {count} usable {'view' if count == 1 else 'views'}",
                f"at least {LEAST_VIEWS} of the board in different places and tilts; 15 to 20 make a good calibration",
            )  # fmt: skip


def require_tilt(item: Adjusted, device: str) -> None:
    """Refuse boards that are all parallel: they leave the focal length open.

    Raises
    ------
    InputError
        Naming the number of boards and the largest angle between them.
    """
    spread = tilt_spread_deg(item.state.T_sensor_board[item.problem.seen_by(device)])
    count = int(item.problem.seen_by(device).sum())
    sigma = focal_sigma(item, device)
    if spread < PARALLEL_DEG or sigma > UNDETERMINED:
        found = f"found all {count} boards parallel within {max(spread, 0.1):.1f} degrees"
        if spread >= PARALLEL_DEG:
            found = f"found {count} boards that leave the focal length open by {100 * sigma:.0f} %"
        raise InputError(f"boards of {words(device)}", found, f"boards that differ in tilt: {ADVICE}")


def tilt_spread_deg(T_sensor_board: Array) -> float:
    """Return the largest angle [deg] between two boards' normals."""
    normals = T_sensor_board[:, :3, 2]
    cosines = np.clip(normals @ normals.T, -1.0, 1.0)
    return float(np.rad2deg(np.arccos(cosines.min(initial=1.0))))


def focal_sigma(item: Adjusted, device: str) -> float:
    """Return the relative standard deviation of a device's focal length."""
    at = item.free.columns(device)[0]
    return float(np.sqrt(item.covariance()[at, at]) / item.state.devices[device].K[0, 0])


def weak_geometry(item: Adjusted) -> tuple[Finding, ...]:
    """Return per device how many views there are, how the boards are tilted, and what the focal length is worth."""
    findings = []
    for device in item.problem.devices:
        seen = item.problem.seen_by(device)
        count, spread = int(seen.sum()), tilt_spread_deg(item.state.T_sensor_board[seen])
        few = f"{words(device)} has {count} views of the board only; 15 to 20 make a good calibration"
        findings.append(Finding(
            f"views of {words(device)}", float(count), None, "", "counted", few if count < FEW_VIEWS else ""
        ))  # fmt: skip
        flat = f"the boards that {words(device)} sees differ by {spread:.0f} degrees in tilt: {ADVICE}"
        findings.append(Finding(
            f"tilt between boards of {words(device)}", spread, None, "deg", "largest angle between two",
            flat if spread < WEAK_DEG else "",
        ))  # fmt: skip
        sigma = focal_sigma(item, device)
        told = f"the focal length of {words(device)} is known to {100 * sigma:.1f} % only: take more boards; {ADVICE}"
        findings.append(Finding(
            f"relative standard deviation of the focal length of {words(device)}", sigma, None, "", "covariance",
            told if sigma > WEAK else "",
        ))  # fmt: skip
    return tuple(findings)
