"""Whether the real captures are measured at the limit that the noise of their grey values sets.

    python benchmarks/noise_limit.py

Three things must agree where noise is the limit: the noise of the grey values, as the phase steps show it, with the
noise model; the spread of the points between pixels a few apart with their sigma; and the whole spread of the points
about their form with both. What exceeds the second in the last is no noise: calibration, form or light.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.measurement import Measurement
from planish.sensing.capture.sequence import read_layouts
from points import spread
from render_tables import ROOT, save_table

sys.path.extend([str(ROOT / "tests"), str(ROOT / "tests" / "real")])
from captures import load, measured
from test_ball import CENTER_PX, RADIUS_PX
from test_steel import PATCHES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Pixels between which neither the interpolation of the other camera (4 x 4 pixels) nor the lens makes errors alike.
APART_PX = 4
#: Every so many pixels of a part serve for its grey values.
EVERY = 7
#: Degree of the polynomial over the part that stands for slow errors of form.
SLOW_DEGREE = 6
#: Farther from the form than so many robust standard deviations is not used to fit it.
CLIP_SIGMAS = 6.0


@dataclass(frozen=True)
class Form:
    """Distances of a part's points from their form, and what they should be, on the pixel grid (NaN elsewhere)."""

    distance_mm: Array
    predicted_mm: Array


def form_of(item: Measurement, part: Mask, ball: bool) -> Form:
    """Distances along the normal from the best sphere or plane, and sigma_mm projected onto the normal."""
    part = part & item.valid
    points = item.points_sensor[part].astype(float)
    distance, normal = from_sphere(points) if ball else from_plane(points)
    ray = points - item.camera.center_sensor
    cosine = np.abs((ray * normal).sum(1)) / np.linalg.norm(ray, axis=1)
    maps = np.full((2, *item.shape), np.nan)
    maps[0][part], maps[1][part] = distance, item.sigma_mm[part] * cosine
    return Form(*maps)


def from_sphere(points: Array) -> tuple[Array, Array]:
    """Distances (N,) and normals (N, 3)."""
    origin, use = points.mean(0), np.ones(len(points), bool)
    for _ in range(5):
        x = points[use] - origin
        s = np.linalg.lstsq(np.column_stack([2 * x, np.ones(len(x))]), (x**2).sum(1), rcond=None)[0]
        arm = points - origin - s[:3]
        length = np.linalg.norm(arm, axis=1)
        distance = length - np.sqrt(s[3] + s[:3] @ s[:3])
        use = np.abs(distance) < CLIP_SIGMAS * spread(distance)
    return distance, arm / length[:, None]


def from_plane(points: Array) -> tuple[Array, Array]:
    """Distances (N,) and normal (3,)."""
    use = np.ones(len(points), bool)
    for _ in range(5):
        center = points[use].mean(0)
        normal = np.linalg.svd(points[use] - center, full_matrices=False)[2][2]
        distance = (points - center) @ normal
        use = np.abs(distance) < CLIP_SIGMAS * spread(distance)
    return distance, normal


def white_part(values: Array) -> float:
    """Robust spread that neither slow form nor a slope contributes to: second differences over pixels some apart."""
    n = APART_PX
    along_rows = values[:, 2 * n :] - 2 * values[:, n:-n] + values[:, : -2 * n]
    along_columns = values[2 * n :] - 2 * values[n:-n] + values[: -2 * n]
    both = np.concatenate([along_rows.ravel(), along_columns.ravel()]) / np.sqrt(6)
    return spread(both[np.isfinite(both)])


def without_slow_form(distance: Array) -> float:
    """Robust spread of what a polynomial over the part's pixels leaves of the distances."""
    v, u = np.nonzero(np.isfinite(distance))
    value = distance[v, u]
    x, y = (2 * (p - p.min()) / np.ptp(p) - 1 for p in (u, v))
    terms = np.polynomial.legendre.legvander2d(x, y, [SLOW_DEGREE, SLOW_DEGREE])
    i, j = np.divmod(np.arange(terms.shape[1]), SLOW_DEGREE + 1)
    terms = terms[:, i + j <= SLOW_DEGREE]
    use = np.abs(value) < CLIP_SIGMAS * spread(value)
    return spread(value - terms @ np.linalg.lstsq(terms[use][::EVERY], value[use][::EVERY], rcond=None)[0])


def grey_noise(steps: Array, angles: Array, offset: float, slope: float) -> float:
    """Robust spread of the grey values (steps, pixels) about their fringes, over what the noise model says.

    All harmonics count. What the fringes themselves hold of them is the same at every phase and is taken out: one
    amplitude of sine and cosine for each harmonic and all pixels.
    """
    n = len(angles)
    basis = np.column_stack([np.ones(n), np.cos(angles), np.sin(angles)])
    fitted = basis @ np.linalg.lstsq(basis, steps, rcond=None)[0]
    wave = np.exp(1j * angles) @ steps * (2 / n)
    phase = np.angle(wave) - angles[:, None]
    harmonics = [part(h * phase) * np.abs(wave) for h in range(2, n // 2 + 1) for part in (np.cos, np.sin)]
    shape = np.stack([h.ravel() for h in harmonics], axis=1)
    residual = (steps - fitted).ravel()
    residual = residual - shape @ np.linalg.lstsq(shape, residual, rcond=None)[0]
    sigma = np.sqrt(offset + slope * np.maximum(fitted, 0)).ravel()
    return spread(residual / sigma) * float(np.sqrt(n / (n - 3)))


def grey_ratios(name: str, item: Measurement, parts: dict[str, Mask]) -> dict[str, dict[str, float]]:
    """Measured noise over modelled noise of each part, per camera."""
    capture = load(name)
    period = read_layouts(capture.manifest, str(capture.path))[0].periods[-1]
    found: dict[str, dict[str, float]] = {part: {} for part in parts}
    for camera in ("A", "B"):
        images, noise = capture.read_images(camera), item.views[camera].noise
        for part, mask in parts.items():
            v, u = (x[::EVERY] for x in np.nonzero(mask & item.valid))
            if camera != item.organised_on:
                assert item.correspondence_px is not None
                u, v = np.rint(item.correspondence_px[v, u]).astype(int).T
            steps = np.stack([images[i][v, u].astype(float) for i in period.images])
            steps = steps[:, steps.max(0) < item.views[camera].saturation]
            found[part][camera] = grey_noise(steps, period.angles, noise.offset, noise.slope)
    return found


def efficient_share(item: Measurement, part: Mask) -> float:
    """Sigma of the most efficient estimate over that of equal weights, of the own phase.

    Cramer-Rao: the variance being offset + slope I, the information of many steps is the sum of B^2 sin^2 / variance,
    N B^2 (1 - sqrt(1 - m^2)) / (m^2 var(A)) with m = slope B / (offset + slope A); equal weights use
    N B^2 / (2 var(A)).
    """
    view, use = item.views[item.organised_on], part & item.valid
    assert view.mean is not None
    assert view.modulation is not None
    mean, modulation = view.mean[use].astype(float), view.modulation[use].astype(float)
    m = np.clip(view.noise.slope * modulation / (view.noise.offset + view.noise.slope * mean), 1e-3, 0.99)
    return float(np.median(np.sqrt(m**2 / (2 * (1 - np.sqrt(1 - m**2))))))


def rows_of(name: str, parts: dict[str, Mask], item: Measurement, ball: bool) -> list[dict[str, float | str]]:
    """One row per part of a capture."""
    grey = grey_ratios(name, item, parts)
    rows: list[dict[str, float | str]] = []
    for what, mask in parts.items():
        form = form_of(item, mask, ball)
        distance, predicted = form.distance_mm, form.predicted_mm
        known = np.isfinite(distance)
        white = white_part(distance / predicted)
        whole = spread((distance / predicted)[known])
        median = float(np.median(predicted[known]))
        rows.append({"what": what, "grey_a": grey[what]["A"], "grey_b": grey[what]["B"], "predicted": median,
                     "white": white_part(distance), "whole": spread(distance[known]),
                     "fast": without_slow_form(distance), "white_ratio": white,
                     "whole_ratio": whole, "efficient": efficient_share(item, mask)})  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    ball, steel = measured("ball_12step"), measured("steel_corner_shiftline")
    v, u = np.indices(ball.shape)
    disc = (u - CENTER_PX[0]) ** 2 + (v - CENTER_PX[1]) ** 2 <= RADIUS_PX**2
    patches = {}
    for name, ((u0, u1), (v0, v1), _, _) in PATCHES.items():
        patches[f"steel, {name}"] = np.zeros(steel.shape, bool)
        patches[f"steel, {name}"][v0:v1, u0:u1] = True
    rows = rows_of("ball_12step", {"ball, disc": disc}, ball, True)
    rows += rows_of("steel_corner_shiftline", patches, steel, False)
    columns = {"what": "part", "grey_a": "grey noise / model, A", "grey_b": "B",
               "predicted": "predicted sigma along the normal [mm]", "white": "white part [mm]",
               "whole": "whole [mm]", "fast": "whole without slow form [mm]", "white_ratio": "white / predicted",
               "whole_ratio": "whole / predicted",
               "efficient": "best estimate / equal weights"}  # fmt: skip
    formats = dict.fromkeys(("grey_a", "grey_b", "white_ratio", "whole_ratio", "efficient"), ".3f")
    save_table("noise-limit", columns, rows, "python benchmarks/noise_limit.py",
               {**formats, **dict.fromkeys(("predicted", "white", "whole", "fast"), ".4f")})  # fmt: skip


if __name__ == "__main__":
    main()
