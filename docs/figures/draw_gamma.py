"""Draws docs/figures/gamma.svg: what a gamma does to a line of points. python docs/figures/draw_gamma.py [FOLDER]."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from planish.geometry import Array, compose, exp_so3, invert
from planish.rig import Camera
from planish.sensing.decode import PhaseMap
from planish.sensing.points.correspond import correspond
from planish.sensing.points.projector import intersect
from planish.sensing.points.triangulate import triangulate
from planish.sensing.waveform.gamma import estimate_wave_error, without_wave_error

SIZE_PX, PERIOD_PX, STEPS, GAMMA, SIGMA_PX = (640, 120), 20.0, 3, 2.2, 0.01
COLUMNS, ROW = slice(300, 400), 60
WIDTH, HEIGHT, LEFT, TOP = 640, 110, 60, 24
COLORS = ("#b5482e", "#2e6fb5", "#2f8f4e")


def camera(x_mm: float, size_px: tuple[int, int], focal_px: float) -> Camera:
    """A device that looks at the origin from (x, 0, -800) mm."""
    turn = exp_so3([0.0, -np.arctan2(x_mm, 800.0), 0.0])
    K = [[focal_px, 0, size_px[0] / 2], [0, focal_px, size_px[1] / 2], [0, 0, 1]]
    return Camera.make(K, [], size_px, invert(compose(turn, [x_mm, 0, -800.0])))


def phases(place: Array, projector_px: int) -> PhaseMap:
    """What three steps decode of a cosine to the power of GAMMA at these places."""
    x = 2 * np.pi * np.arange(4096) / 4096
    wave = (0.5 + 0.5 * np.cos(x)) ** GAMMA
    angles = 2 * np.pi * np.arange(STEPS) / STEPS
    decoded = np.angle(sum(np.interp(x - a, x, wave, period=2 * np.pi) * np.exp(1j * a) for a in angles))
    error = np.angle(np.exp(1j * (decoded - x)))
    phase = 2 * np.pi * place / PERIOD_PX
    bent = place + PERIOD_PX / (2 * np.pi) * np.interp(phase, x, error, period=2 * np.pi)
    bent += SIGMA_PX * np.random.default_rng(projector_px).standard_normal(place.shape)
    sigma = np.full(place.shape, SIGMA_PX, np.float32)
    return PhaseMap("u", bent.astype(np.float32), sigma, np.zeros(place.shape, np.uint16))


def errors() -> list[tuple[str, Array]]:
    """Errors of depth [mm] over COLUMNS of one row of a plane, by name."""
    a, b = camera(-150, SIZE_PX, 900), camera(150, SIZE_PX, 900)
    projector = camera(0, (640, 400), 900)
    maps, truth = {}, {}
    for name, device in (("A", a), ("B", b)):
        u, v = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1]))
        rays = device.rays_sensor(np.stack([u, v], -1))
        center = device.center_sensor
        truth[name] = center - center[2] / rays[..., 2:] * rays
        maps[name] = phases(projector.project(truth[name])[..., 0], ord(name))
    straight = {}
    for name, phase in maps.items():
        error = estimate_wave_error(phase, PERIOD_PX, STEPS)
        assert error is not None
        straight[name] = without_wave_error(phase, error, PERIOD_PX)

    def depth(points: Array) -> Array:
        distance = [np.linalg.norm(x - a.center_sensor, axis=-1) for x in (points, truth["A"])]
        return np.asarray((distance[0] - distance[1])[ROW, COLUMNS])

    def between(which: dict[str, PhaseMap]) -> Array:
        return depth(triangulate(correspond(which["A"], which["B"], a, b, 1), a, b, 1).points_sensor)

    single, corrected = (
        depth(intersect({"u": which["A"]}, "u", a, projector, 1).points_sensor) for which in (maps, straight)
    )
    return [
        ("camera and projector, as decoded", single),
        ("two cameras, as decoded", between(maps)),
        ("camera and projector, corrected", corrected),
        ("two cameras, corrected", between(straight)),
    ]


def draw() -> str:
    """Return the SVG."""
    rows = errors()
    largest = 1.1 * max(float(np.nanmax(np.abs(values))) for _, values in rows)
    parts = []
    for i, (name, values) in enumerate(rows):
        middle = TOP + i * HEIGHT + HEIGHT / 2 - 6
        x = LEFT + np.linspace(0, WIDTH - LEFT - 10, len(values))
        y = middle - values / largest * (HEIGHT / 2 - 14)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))
        rms = float(np.sqrt(np.nanmean(values**2)))
        parts += [
            f'<text x="{LEFT}" y="{middle - HEIGHT / 2 + 10:.0f}">{name}: rms {rms:.2f} mm</text>',
            f'<line x1="{LEFT}" y1="{middle:.1f}" x2="{WIDTH - 10}" y2="{middle:.1f}" stroke="#bbb"/>',
            f'<polyline points="{points}" fill="none" stroke="{COLORS[min(i, 2)]}" stroke-width="1.3"/>',
        ]
        for level in (-1, 1):
            at = middle - level * (HEIGHT / 2 - 14) / 1.1
            parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.0f}" text-anchor="end">{level * largest / 1.1:+.1f}</text>')
    bottom = TOP + len(rows) * HEIGHT
    caption = f"one row of a plane, {len(rows[0][1])} pixels; error along the ray [mm]"
    parts.append(f'<text x="{LEFT}" y="{bottom + 6}">{caption}</text>')
    size = f'viewBox="0 0 {WIDTH} {bottom + 16}" width="{WIDTH}" height="{bottom + 16}"'
    style = 'font-family="sans-serif" font-size="12" fill="#333"'
    background = f'<rect width="{WIDTH}" height="{bottom + 16}" fill="#fff"/>'
    lines = "\n".join(parts)
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>\n{background}\n{lines}\n</svg>\n'


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    (folder / "gamma.svg").write_text(draw(), encoding="utf-8")
