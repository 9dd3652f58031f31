"""Data of the 3D view: each measurement as a thinned grid with three sets of colours, for plotly.js."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from planish.report.scene import Item, Scene
from planish.report.style import DIVERGING, NEUTRAL, colour

#: Colour index of points outside all overlaps. It lies in the middle, between the smallest negative and the smallest
#: positive error, because the browser blends the indices of neighbouring points: a jump must not cross other colours.
OUTSIDE = 128
NEGATIVE, POSITIVE = (0, 126), (130, 255)


def view_data(scene: Scene) -> dict[str, Any]:
    """Return what `view.js` draws; arrays in plotly's base64 form, positions relative to the scene's centre."""
    groups = {placed.name: placed.group for placed in scene.registration.measurements}
    traces = [_trace(item, groups[item.name], scene.limit_mm) for item in scene.items]
    return {
        "traces": traces,
        "groups": list(scene.groups),
        "limit_mm": scene.limit_mm,
        "error_scale": _error_scale(),
        "error_ticks": [NEGATIVE[0], OUTSIDE, POSITIVE[1]],
        "error_labels": [f"−{scene.limit_mm:.3g}", "0", f"+{scene.limit_mm:.3g}"],
        "camera": _camera(scene),
    }


def _error_scale() -> list[tuple[float, str]]:
    """Colour scale of the error's indices, as plotly wants it: (position, colour)."""
    low, middle, high = DIVERGING[:2], DIVERGING[2], DIVERGING[3:]
    blue = [(NEGATIVE[1] * i / 2 / 255, tone) for i, tone in enumerate((*low, middle))]
    red = [((POSITIVE[0] + (255 - POSITIVE[0]) * i / 2) / 255, tone) for i, tone in enumerate((middle, *high))]
    return [*blue, ((OUTSIDE - 1) / 255, NEUTRAL), ((OUTSIDE + 1) / 255, NEUTRAL), *red]


def _trace(item: Item, group: int, limit_mm: float) -> dict[str, Any]:
    points, grey, error = item.grid.points, item.grid.grey, item.grid.error_mm
    known = np.isfinite(points[..., 2])
    seen = grey[np.isfinite(grey)]
    low, high = np.quantile(seen, [0.01, 0.99]) if len(seen) else (0.0, 1.0)
    tone = np.nan_to_num((grey - low) / max(high - low, 1e-6)).clip(0, 1)
    scaled = np.nan_to_num(error / limit_mm).clip(-1, 1)
    quantised = np.where(
        scaled < 0,
        NEGATIVE[1] + scaled * (NEGATIVE[1] - NEGATIVE[0]),
        POSITIVE[0] + scaled * (POSITIVE[1] - POSITIVE[0]),
    )
    quantised = np.where(np.isfinite(error), np.rint(quantised), OUTSIDE)
    # Only z says where there is a hole: NaN in x or y breaks the bounds of the view, and places far away the shading.
    x, y, z = (points[..., i] for i in range(3))
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    x, y = (np.nan_to_num(values[tuple(nearest)]) for values in (x, y))
    return {
        "name": item.name,
        "group": group,
        "colour": colour(item.index),
        "points": item.points,
        "x": _array(x.astype(np.float32)),
        "y": _array(y.astype(np.float32)),
        "z": _array(np.where(known, z, np.float32(np.nan)).astype(np.float32)),
        "grey": _array(np.rint(tone * 255).astype(np.uint8)),
        "error": _array(quantised.astype(np.uint8)),
    }


def _array(values: NDArray[Any]) -> dict[str, str]:
    kind = {"float32": "f4", "uint8": "u1"}[values.dtype.name]
    return {
        "dtype": kind,
        "bdata": base64.b64encode(np.ascontiguousarray(values).data).decode("ascii"),
        "shape": ", ".join(str(n) for n in values.shape),
    }


def _camera(scene: Scene) -> dict[str, list[float]]:
    """Viewing direction of the first view: that of the overview picture."""
    T_view_world = scene.plan.T_view_world
    return {"eye": (-1.35 * T_view_world[2, :3]).tolist(), "up": (-T_view_world[1, :3]).tolist()}
