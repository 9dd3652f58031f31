"""Whether calibrations are as good as they say: simulated boards, known rigs, many draws of noise and of the pitch.

    python benchmarks/calibrate.py [--seeds 200]

Per kind of sensor: parameters in predicted standard deviations, NEES per degree of freedom, coverage of 95 % intervals,
the true error of measured points over the one expected from the covariance, and CPU time. Then boards that are not as
their file says: what is reported.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planish.geometry import Array, invert, log_se3
from planish.rig import Rig
from planish.rig.derivatives import point_derivatives
from planish.rig.parameters import DEVICE_PARAMETERS
from planish.sensing.calibrate.calibrate import CalibrateOptions, calibrate
from planish.sensing.calibrate.result import Calibration
from planish.sensing.capture.board import parse_board
from planish.simulation.board_places import board_places
from planish.simulation.boards import PrintedBoard
from planish.simulation.sensor import reference_rig
from render_tables import ROOT, save_table

sys.path.append(str(ROOT / "tests"))
from seen_boards import observations

#: Noise of corners and of the projector's positions [px], and the board's relative standard deviation of scale.
NOISE_PX, PITCH_SIGMA = 0.05, 1e-4
VIEWS = 20
#: So many draws share the same places of the board.
DRAWS_PER_PLACES = 20
#: Quantile of the normal distribution for 95 % intervals.
TWO_SIDED_95 = 1.959964
SENSORS = {"two cameras": ("A", "B"), "camera and projector": ("A", "projector"), "all three": ("A", "B", "projector")}
BOARD = {
    "schema": "planish.board/1", "kind": "chessboard", "corners": (11, 8), "pitch_mm": 20.0, "pitch_sigma": PITCH_SIGMA,
}  # fmt: skip
#: Points of the map of the expected error: columns and rows over the image of camera A, on the plane z = 0.
MAP = (9, 7)


def stated_board(**changes) -> PrintedBoard:
    """The board as its file states it, made with the errors in `changes`."""
    return PrintedBoard(parse_board(BOARD, "board"), **changes)


def errors_of(calibration: Calibration, true_in_A: Rig) -> Array:
    """Error (n,) of each parameter of the covariance: what has to be added to get the true rig."""
    found = calibration.rig
    each = {}
    for name, device in found.devices.items():
        true = true_in_A.devices[name]
        K = true.K - device.K
        external = log_se3(true.T_camera_sensor @ invert(device.T_camera_sensor))
        each[name] = np.r_[K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], true.distortion - device.distortion, external]
    split = [name.partition(".") for name in found.covariance_parameters]
    return np.array([each[device][DEVICE_PARAMETERS.index(parameter)] for device, _, parameter in split])


@dataclass(frozen=True)
class Draw:
    """One calibration against the truth."""

    normalised: Array
    nees: float
    points_true: Array
    points_expected: Array
    seconds: float
    models: tuple[str, ...]


def draw(devices: tuple[str, ...], seed: int, places: list[Array]) -> Draw:
    """Calibrate boards of a drawn pitch, seen with drawn noise."""
    true = reference_rig()
    scale = 1 + PITCH_SIGMA * np.random.default_rng([seed, 7]).standard_normal()
    made = stated_board(scale=(scale, scale))
    seen = observations(true, made, places, NOISE_PX, seed, devices)
    start = time.process_time()
    found = calibrate(seen, CalibrateOptions(), threads=1)
    seconds = time.process_time() - start
    true_in_A = true.in_frame_of("A")
    error, covariance = errors_of(found, true_in_A), found.rig.covariance
    assert covariance is not None
    other = "B" if "B" in devices else "projector"
    J = point_derivatives(found.rig, "A", other, map_points(true_in_A), found.rig.covariance_parameters)
    return Draw(
        error / np.sqrt(np.diag(covariance)),
        float(error @ np.linalg.solve(covariance, error)) / len(error),
        np.linalg.norm(J @ error, axis=1),
        np.sqrt(np.einsum("nij,jk,nik->n", J, covariance, J)),
        seconds,
        tuple(found.models[name].name for name in devices),
    )


def map_points(true_in_A: Rig) -> Array:
    """Points (N, 3) of the plane z = 0 of the reference sensor, over the image of camera A, in its frame [mm]."""
    camera = true_in_A.cameras["A"]
    u, v = (np.linspace(0.03, 0.97, n) * size for n, size in zip(MAP, camera.size_px, strict=True))
    rays = camera.rays_sensor(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    T_A_reference = reference_rig().cameras["A"].T_camera_sensor
    normal, origin = T_A_reference[:3, 2], T_A_reference[:3, 3]
    return np.asarray(rays * ((origin @ normal) / (rays @ normal))[:, None])


def row(kind: str, draws: list[Draw]) -> dict[str, object]:
    """One line of the table."""
    normalised = np.concatenate([item.normalised for item in draws])
    ratio = np.sqrt(
        np.mean([item.points_true**2 for item in draws], 0) / np.mean([item.points_expected**2 for item in draws], 0)
    )
    within = np.mean([np.median(item.points_true) / np.median(item.points_expected) for item in draws])
    return {
        "sensor": kind,
        "draws": len(draws),
        "nees": float(np.mean([item.nees for item in draws])),
        "coverage": 100 * float(np.mean(np.abs(normalised) < TWO_SIDED_95)),
        "inside_3_sigma": 100 * float(np.mean(np.abs(normalised) < 3)),
        "largest": float(np.abs(normalised).max()),
        "points_ratio": float(np.median(ratio)),
        "points_ratio_least": float(ratio.min()),
        "points_ratio_most": float(ratio.max()),
        "points_median": float(within),
        "expected_mm": float(np.median([np.median(item.points_expected) for item in draws])),
        "seconds": float(np.median([item.seconds for item in draws])),
        "radial": 100 * float(np.mean([name == "radial" for item in draws for name in item.models])),
    }


COLUMNS = {
    "sensor": "sensor", "draws": "draws", "nees": "NEES / dof", "coverage": "95 % intervals hold [%]",
    "inside_3_sigma": "within 3 sigma [%]", "points_ratio": "3D error, true / expected (median over the map)",
    "points_ratio_least": "least", "points_ratio_most": "most", "expected_mm": "expected 3D error, median [mm]",
    "radial": "model k1 k2 chosen [%]", "seconds": "CPU [s]",
}  # fmt: skip
FORMATS = {
    "nees": ".3f", "coverage": ".1f", "inside_3_sigma": ".2f", "points_ratio": ".3f", "points_ratio_least": ".3f",
    "points_ratio_most": ".3f", "expected_mm": ".3f", "radial": ".0f", "seconds": ".2f",
}  # fmt: skip
#: A wrong board: how it was made, what its file says besides, the finding, and the true value.
FAULTS: dict[str, tuple[dict[str, object], dict[str, object], str, float]] = {
    "none": ({}, {}, "bending of the board", 0.0),
    "pitch along x 0.1 % longer than along y": (
        {"scale": (1.0005, 0.9995)}, {}, "pitch ratio x / y of the board", 1.0005 / 0.9995,
    ),
    "bent by 1 mm": ({"sagitta_mm": 1.0}, {}, "bending of the board", 1.0),
    "known length 0.1 % longer than by the pitch": (
        {}, {"known_length": {"first": (0, 0), "second": (10, 0), "length_mm": 200.2, "sigma_mm": 0.01}},
        "known length against pitch", 0.001,
    ),
}  # fmt: skip
FAULT_DRAWS = 20


def fault_row(fault: str) -> dict[str, object]:
    """What calibrations by a wrong board report, over FAULT_DRAWS draws of noise."""
    made, stated, quantity, true = FAULTS[fault]
    board = PrintedBoard(parse_board({**BOARD, **stated}, "board"), **made)
    places = board_places(reference_rig(), board, VIEWS, devices=("A", "B"), seen_share=0.8)
    true_in_A = reference_rig().in_frame_of("A")
    values, sigmas, warned, nees = [], [], [], []
    for seed in range(FAULT_DRAWS):
        found = calibrate(observations(reference_rig(), board, places, NOISE_PX, seed, ("A", "B")), threads=1)
        finding = next(item for item in found.findings if item.quantity == quantity)
        values.append(finding.value)
        sigmas.append(finding.sigma)
        warned.append(bool(finding.warning))
        error = errors_of(found, true_in_A)
        nees.append(float(error @ np.linalg.solve(found.rig.covariance, error)) / len(error))
    return {
        "fault": fault, "quantity": quantity, "true": true, "value": float(np.mean(values)),
        "spread": float(np.std(values, ddof=1)), "sigma": float(np.mean(sigmas)),
        "reported": 100 * float(np.mean(warned)),
        "nees": float(np.mean(nees)),
    }  # fmt: skip


FAULT_COLUMNS = {
    "fault": "board", "quantity": "finding", "true": "true", "value": "reported, mean", "spread": "spread",
    "sigma": "stated sigma", "reported": "warned [%]", "nees": "NEES / dof",
}  # fmt: skip
FAULT_FORMATS = {"true": ".5g", "value": ".5g", "spread": ".2g", "sigma": ".2g", "reported": ".0f", "nees": ".2f"}


def draws_of(devices: tuple[str, ...], seeds: Sequence[int]) -> list[Draw]:
    """Calibrations of all seeds; some of them share the places of the board."""
    draws = []
    for seed in seeds:
        if seed % DRAWS_PER_PLACES == 0 or not draws:
            places = board_places(reference_rig(), stated_board(), VIEWS, seed, devices=devices, seen_share=0.8)
        draws.append(draw(devices, seed, places))
    return draws


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    chosen = parser.parse_args()
    rows = [row(kind, draws_of(devices, range(chosen.seeds))) for kind, devices in SENSORS.items()]
    faults = [fault_row(fault) for fault in FAULTS]
    print(*rows, *faults, sep="\n")
    if chosen.seeds >= 200:
        save_table("calibrate", COLUMNS, rows, "python benchmarks/calibrate.py", FORMATS)
        save_table("calibrate-faults", FAULT_COLUMNS, faults, "python benchmarks/calibrate.py", FAULT_FORMATS)


if __name__ == "__main__":
    main()
