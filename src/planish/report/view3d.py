"""Data of the 3D view: each measurement as a thinned grid with three sets of colours, for plotly.js."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.report.scene import Item, Scene
from planish.report.style import DIVERGING, NEUTRAL, colour

#: Most grid points per measurement: what a browser without graphics card still turns smoothly.
MAX_POINTS = 25_000
#: Colour index of points outside all overlaps; the others are 16 ... 255.
OUTSIDE, FIRST = 0, 16


def view_data(scene: Scene) -> dict[str, Any]:
    """Return what `view.js` draws; arrays in plotly's base64 form, positions relative to the scene's centre."""
    traces = [_trace(item, scene.limit_mm) for item in scene.items]
    step = (255 - FIRST) / (len(DIVERGING) - 1)
    error_scale: list[tuple[float, str]] = [(0.0, NEUTRAL), ((FIRST - 1) / 255, NEUTRAL)]
    error_scale += [((FIRST + i * step) / 255, tone) for i, tone in enumerate(DIVERGING)]
    return {
        "traces": traces,
        "groups": list(scene.groups),
        "limit_mm": scene.limit_mm,
        "error_scale": error_scale,
        "error_ticks": [FIRST, FIRST + 2 * step, 255],
        "error_labels": [f"{v:+.3g}" for v in (-scene.limit_mm, 0.0, scene.limit_mm)],
        "camera": _camera(scene),
    }


def grid_step(shape: tuple[int, int]) -> int:
    """Return the smallest step that leaves at most MAX_POINTS grid points."""
    step = 1
    while (-(-shape[0] // step)) * (-(-shape[1] // step)) > MAX_POINTS:
        step += 1
    return step


def _trace(item: Item, limit_mm: float) -> dict[str, Any]:
    points, _, grey, error = item.thinned(grid_step(item.prepared.measurement.shape))
    known = np.isfinite(points[..., 2])
    seen = grey[np.isfinite(grey)]
    low, high = np.quantile(seen, [0.01, 0.99]) if len(seen) else (0.0, 1.0)
    tone = np.nan_to_num((grey - low) / max(high - low, 1e-6)).clip(0, 1)
    scaled = np.nan_to_num(error / (2 * limit_mm) + 0.5, nan=0.5).clip(0, 1)
    quantised = np.where(np.isfinite(error), np.rint(FIRST + scaled * (255 - FIRST)), OUTSIDE)
    # A NaN in x or y breaks the bounds of the view: only z says where there is a hole.
    x, y, z = (points[..., i] for i in range(3))
    return {
        "name": item.placed.name,
        "group": item.placed.group,
        "colour": colour(item.index),
        "points": int(item.prepared.measurement.valid.sum()),
        "x": _array(np.where(known, x, _middle(x, known)).astype(np.float32)),
        "y": _array(np.where(known, y, _middle(y, known)).astype(np.float32)),
        "z": _array(np.where(known, z, np.float32(np.nan)).astype(np.float32)),
        "grey": _array(np.rint(tone * 255).astype(np.uint8)),
        "error": _array(quantised.astype(np.uint8)),
    }


def _middle(values: NDArray[np.float32], known: NDArray[np.bool_]) -> np.float32:
    return np.float32(np.median(values[known])) if known.any() else np.float32(0)


def _array(values: NDArray[Any]) -> dict[str, str]:
    kind = {"float32": "f4", "uint8": "u1"}[values.dtype.name]
    return {
        "dtype": kind,
        "bdata": base64.b64encode(np.ascontiguousarray(values).data).decode("ascii"),
        "shape": ", ".join(str(n) for n in values.shape),
    }


def _camera(scene: Scene) -> dict[str, list[float]]:
    """Viewing direction of the first view: onto the sensor's side of the largest group, a little from below."""
    normals = []
    for item in scene.group(scene.groups[0]):
        n = item.thinned(16)[1].reshape(-1, 3)
        normals.append(n[np.isfinite(n[:, 2])])
    mean = np.concatenate(normals).astype(float).mean(0)
    eye = mean / max(float(np.linalg.norm(mean)), 1e-9)
    across = np.array([0.0, 1.0, 0.0]) if abs(eye[1]) < 0.8 else np.array([1.0, 0.0, 0.0])
    up = across - (across @ eye) * eye
    up /= np.linalg.norm(up)
    eye = eye * 0.95 - up * 0.45
    return {"eye": (1.2 * eye / np.linalg.norm(eye)).tolist(), "up": up.tolist()}
