"""What distances alone and textures alone say about the real steel's transform: which of them is off?

Both measurements come from the same fringes: their points agree whatever the calibration's row error is, and so say
that it is right. The textures do not go through the correspondence: they show the row error.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planish.geometry import Array, difference, perturb
from planish.measurement import Measurement
from planish.pipeline import prepare_run
from planish.registration.pair import refine_pair, register_pair
from planish.registration.refine.information import information
from planish.registration.refine.residuals import equations
from planish.registration.tiles import tile_size_px
from render_tables import save_table

#: Newton steps, and what is left of the last one [mm].
STEPS, ENOUGH_MM = 30, 1e-4


def sources_table(left: Measurement, right: Measurement) -> None:
    """Save the table `real-steel-sources` of two measurements in one frame, and print it."""
    options, prepared = prepare_run([left, right], threads=1)
    a, b = prepared["left"], prepared["right"]
    result = register_pair(a, b, options, 1, 1)
    assert result.T_a_b is not None
    refined = refine_pair(a, b, result.T_a_b, options, 1)
    assert refined is not None
    finest = options.refine.spacing_px[-1]

    def alone(kind: int) -> Array:
        T = refined.T_a_b
        for _ in range(STEPS):
            e = equations(
                a.fit_sides[finest], b.sides[finest], T, refined.about, refined.weights.only(kind),
                max_distance_mm=options.refine.max_distance_mm[-1], max_normal_rad=options.refine.max_normal_rad,
                stride=1, tile_px=tile_size_px(b.measurement), residuals=False, threads=1,
            )  # fmt: skip
            info = information(e, refined.lever_mm)
            xi = -np.linalg.solve(info.total, info.gradient) / info.scale
            T = perturb(T, xi, refined.about)
            if np.linalg.norm(xi[3:]) < ENOUGH_MM:
                break
        return T

    rows: list[dict[str, Any]] = []
    for what, T in (("distances", alone(0)), ("textures", alone(1)), ("both", refined.T_a_b)):
        xi = difference(np.eye(4), T, refined.about)
        rows.append(
            {"what": what, "deg": float(np.rad2deg(np.linalg.norm(xi[:3]))), "mm": float(np.linalg.norm(xi[3:]))}
        )
    print(*rows, sep="\n")
    columns = {"what": "by", "deg": "rotation error [deg]", "mm": "at the centroid [mm]"}
    save_table("real-steel-sources", columns, rows, "python benchmarks/real_steel.py", {"deg": ".4f", "mm": ".4f"})
