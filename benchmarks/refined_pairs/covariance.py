"""Whether the stated covariance is that of the errors: independent pairs, exact rig and rigs drawn from a calibration.

Every pair is rendered once and measured with the true rig and with one drawn from the covariance of a calibration by 20
boards (0.05 px), which the rig then states as its own.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from coarse_pairs.parts import true_transform
from planish.errors import InputError
from planish.geometry import Array, difference
from planish.registration.result import PairResult
from planish.simulation.rigs import draw_rig
from refined_pairs.pairs import draw_pair, with_noise
from refined_pairs.run import known_pair
from render_tables import ROOT
from shared.cells import Rows
from shared.rendered import measure_rendered, render_scene

sys.path.append(str(ROOT / "tests"))
from calibrated_rig import with_calibration

#: One pair after the other in a cell.
PAIRS_PER_CELL = 5
#: Noise of these pairs is that of others: none is drawn twice.
FIRST_NUMBER = 1000


def run_pairs(kind: str, noise: float, scale: float, block: int) -> Rows:
    """Return the records of one block of pairs, each with both rigs."""
    rows: Rows = []
    for number in range(FIRST_NUMBER + block * PAIRS_PER_CELL, FIRST_NUMBER + (block + 1) * PAIRS_PER_CELL):
        part, case = draw_pair(kind, number, scale)
        scene = with_noise(part.scene(), noise)
        captures = [render_scene(scene, i) for i in (case.first, case.second)]
        stated = with_calibration(scene.rig)
        for rig_kind, rig in (("exact", None), ("drawn", draw_rig(stated, number))):
            row: dict[str, Any] = {
                "study": "covariance", "kind": kind, "noise": noise, "scale": scale, "number": number, "rig": rig_kind
            }  # fmt: skip
            rows.append(row)
            try:
                a, b = (measure_rendered(c, rig) for c in captures)
            except InputError as error:
                row |= {"status": "not measured", "reason": str(error)}
                continue
            pair = known_pair((a, b), true_transform(part, case))
            result = pair.register()
            row |= {"status": result.status, "reason": result.reason}
            if result.T_a_b is not None:
                row["along_mm"], row["normal_mm"] = pair.errors_mm(result.T_a_b)
                row |= errors_in_sigmas(result, pair.T_a_b)
    return rows


def errors_in_sigmas(result: PairResult, T_true: Array) -> dict[str, Any]:
    """Return the error along the axes of the stated covariance, widest first, in its standard deviations, and these.

    `noise`: with the covariance of the noise alone; `total`: with that of the calibration too, where there is one.
    """
    assert result.T_a_b is not None
    xi = difference(T_true, result.T_a_b, result.covariance_point_mm)
    stated = {"noise": result.covariance_noise}
    if result.covariance_calibration is not None:
        stated["total"] = result.covariance_noise + result.covariance_calibration
    found: dict[str, Any] = {"xi": xi.tolist()}
    for name, C in stated.items():
        # Rotations count at 100 mm from the centre, about the rim of the overlap.
        scale = np.array([100.0] * 3 + [1.0] * 3)
        values, vectors = np.linalg.eigh(C * np.outer(scale, scale))
        sigmas = np.sqrt(np.maximum(values, 0))[::-1]
        z = ((vectors.T @ (scale * xi)) / np.sqrt(np.maximum(values, 1e-30)))[::-1]
        found |= {f"z_{name}": _rounded(z), f"sigma_{name}_mm": _rounded(sigmas)}
    return found


def _rounded(values: Sequence[float] | Array) -> list[float]:
    return [float(f"{v:.5g}") for v in values]
