"""Draws the figures of docs/conventions.md as SVG: python docs/figures/draw_conventions.py [FOLDER]."""

from __future__ import annotations

import html
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

Point = tuple[float, float]

RED, GREEN, BLUE, INK, FAINT, FILL = "#c0392b", "#1e8449", "#1f5fa8", "#222222", "#999999", "#eef2f7"


class Drawing:
    """A list of SVG elements with a size; y points down."""

    def __init__(self, width: int, height: int) -> None:
        self.size = (width, height)
        self.elements: list[str] = [f'<rect width="{width}" height="{height}" fill="white"/>']

    def line(
        self, a: Point, b: Point, color: str = INK, width: float = 1.5, dash: str = "", head: bool = False
    ) -> None:
        """Draw a straight line, with an arrow head at b if asked."""
        extra = f' stroke-dasharray="{dash}"' if dash else ""
        self.elements.append(
            f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" stroke="{color}" '
            f'stroke-width="{width}"{extra}/>'
        )
        if head:
            self.head(a, b, color)

    def head(self, a: Point, b: Point, color: str) -> None:
        """Draw an arrow head at b of the line from a."""
        angle = math.atan2(b[1] - a[1], b[0] - a[0])
        corners = [b, *((b[0] - 9 * math.cos(angle + s), b[1] - 9 * math.sin(angle + s)) for s in (-0.4, 0.4))]
        self.polygon(corners, color, color)

    def polygon(self, points: Iterable[Point], fill: str = FILL, stroke: str = INK, width: float = 1) -> None:
        """Draw a filled polygon."""
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self.elements.append(f'<polygon points="{text}" fill="{fill}" stroke="{stroke}" stroke-width="{width}"/>')

    def curve(self, points: Iterable[Point], color: str = INK, width: float = 1.5, dash: str = "") -> None:
        """Draw a line through points."""
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        extra = f' stroke-dasharray="{dash}"' if dash else ""
        self.elements.append(f'<polyline points="{text}" fill="none" stroke="{color}" stroke-width="{width}"{extra}/>')

    def dot(self, p: Point, color: str = INK, radius: float = 3.5) -> None:
        """Draw a filled circle."""
        self.elements.append(f'<circle cx="{p[0]:.1f}" cy="{p[1]:.1f}" r="{radius}" fill="{color}"/>')

    def text(self, p: Point, text: str, color: str = INK, size: int = 14, anchor: str = "start") -> None:
        """Write text at p."""
        style = f'font-size="{size}" fill="{color}" text-anchor="{anchor}"'
        self.elements.append(f'<text x="{p[0]:.1f}" y="{p[1]:.1f}" {style}>{html.escape(text, quote=False)}</text>')

    def axes(self, origin: Point, directions: Sequence[tuple[str, Point]], length: float = 55) -> None:
        """Draw named axes: x red, y green, z blue."""
        for name, (dx, dy) in directions:
            color = {"x": RED, "y": GREEN, "z": BLUE}[name]
            end = (origin[0] + length * dx, origin[1] + length * dy)
            self.line(origin, end, color, 2, head=True)
            self.text((origin[0] + (length + 14) * dx - 4, origin[1] + (length + 14) * dy + 5), name, color)
        self.dot(origin)

    def svg(self) -> str:
        """Return the whole drawing as text."""
        width, height = self.size
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
        )
        return "\n".join([f'{head} font-family="sans-serif">', *self.elements, "</svg>", ""])


def rotated(degrees: float) -> Point:
    """Return the direction at an angle against the picture's x axis, clockwise."""
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def draw_frames() -> Drawing:
    """Two sensor frames see one point; T_a_b maps its coordinates in b to those in a."""
    d = Drawing(640, 300)
    a, b, x = (150.0, 205.0), (490.0, 205.0), (335.0, 60.0)
    d.axes(a, [("x", rotated(140)), ("y", rotated(0)), ("z", rotated(-90))])
    d.axes(b, [("x", rotated(115)), ("y", rotated(-25)), ("z", rotated(-115))])
    d.text((a[0] - 80, a[1] - 8), "frame a")
    d.text((b[0] + 20, b[1] + 30), "frame b")
    for origin, name in ((a, "x_a"), (b, "x_b")):
        d.line(origin, x, FAINT, dash="5 4")
        d.text(((origin[0] + x[0]) / 2 + (-38 if name == "x_a" else 8), (origin[1] + x[1]) / 2 - 6), name)
    d.dot(x, INK, 5)
    d.text((x[0] + 10, x[1] - 8), "the same point")
    steps = [i / 40 for i in range(41)]
    arc = [(b[0] - 45 + (a[0] + 90 - b[0]) * s, b[1] + 15 + 30 * math.sin(math.pi * s)) for s in steps]
    d.curve(arc, INK, 2)
    d.head(arc[-3], arc[-1], INK)
    d.text((320, 280), "T_a_b :   x_a = T_a_b x_b", anchor="middle")
    return d


def draw_pixels() -> Drawing:
    """The centre of the first pixel is (0, 0); the image begins at -0.5."""
    d = Drawing(640, 300)
    side, left, top = 70, 150, 60
    for v in range(3):
        for u in range(5):
            x, y = left + side * u, top + side * v
            d.polygon([(x, y), (x + side, y), (x + side, y + side), (x, y + side)], FILL, FAINT)
            d.dot((x + side / 2, y + side / 2), INK, 2.5)
    center = (left + side / 2, top + side / 2)
    d.line(center, (left + 5 * side + 50, center[1]), RED, 2, head=True)
    d.line(center, (center[0], top + 3 * side + 25), GREEN, 2, head=True)
    d.dot(center, INK, 5)
    d.text((left + 5 * side + 58, center[1] + 5), "u, column", RED)
    d.text((center[0] + 10, top + 3 * side + 26), "v, row", GREEN)
    d.text((center[0] - 10, center[1] - 12), "(0, 0)", anchor="middle")
    d.text((center[0] + side, center[1] - 12), "(1, 0)", anchor="middle")
    d.text((center[0] + 2 * side, center[1] + 2 * side - 12), "(2, 2)", anchor="middle")
    d.dot((left, top), BLUE, 4)
    d.text((left - 12, top - 12), "image corner (-0.5, -0.5)", BLUE, anchor="start")
    return d


def draw_phase() -> Drawing:
    """A fringe pattern over projector pixels, its second step, and the Gray code below."""
    d = Drawing(640, 380)
    left, scale, base, height = 60, 17, 130, 45
    period, steps = 16, 4

    def along(u: float) -> float:
        return left + scale * (u + 0.5)

    def wave(k: int) -> list[Point]:
        grid = [i / 8 for i in range(-4, 8 * 31 + 5)]
        return [(along(u), base - height * math.cos(2 * math.pi * u / period - 2 * math.pi * k / steps)) for u in grid]

    d.line((along(-0.5), base), (along(32), base), FAINT, head=True)
    d.text((along(31.5), base + 66), "u [projector px]", anchor="end", size=12)
    d.curve(wave(0), BLUE, 2)
    d.curve(wave(1), RED, 2, "6 4")
    d.line((along(0), 40), (along(0), 280), FAINT, 1, "3 3")
    d.line((along(0), 55), (along(period), 55), INK, 1, head=True)
    d.line((along(period), 55), (along(0), 55), INK, 1, head=True)
    d.text((along(period / 2), 48), "period_px = 16:  phi = 2 pi u / period_px", anchor="middle", size=12)
    d.line((along(0), base + 62), (along(period / steps), base + 62), RED, 1.5, head=True)
    d.text((along(period / steps) + 6, base + 66), "one step, sign = +1: towards larger u", RED, 12)
    d.text((along(31), base - height - 14), "step 0", BLUE, 13, "middle")
    d.text((along(20), base - height - 14), "step 1", RED, 13, "middle")
    cell = period // 2
    for row, bit in enumerate((1, 0)):
        y = 215 + 34 * row
        for u in range(32):
            code = (u // cell) ^ (u // cell >> 1)
            fill = "white" if code >> bit & 1 else "#555555"
            d.polygon(
                [(along(u - 0.5), y), (along(u + 0.5), y), (along(u + 0.5), y + 24), (along(u - 0.5), y + 24)], fill
            )
        d.text((left - 8, y + 17), f"bit {bit}", anchor="end", size=12)
    for k in range(4):
        d.text((along(cell * k + (cell - 1) / 2), 300), f"cell {k}", anchor="middle", size=12)
    d.text(
        (along(-0.5), 325), "Gray code with cell_px = 8, half a period: cell k is the pixels 8 k ... 8 k + 7", size=12
    )
    d.text((along(-0.5), 348), "u = 0 is the centre of the first projector pixel (dashed)", size=12)
    return d


def draw_chart() -> Drawing:
    """A chart of the surface: x right, y down, z into the surface; normals point to the sensor."""
    d = Drawing(640, 330)
    corners = [(150.0, 160.0), (470.0, 160.0), (560.0, 280.0), (90.0, 280.0)]
    d.polygon(corners, FILL, FAINT)
    origin = (175.0, 172.0)
    d.axes(origin, [("x", (1.0, 0.0)), ("y", (-0.42, 0.9))], 90)
    d.line(origin, (origin[0], origin[1] + 45), BLUE, 2, "4 3", head=True)
    d.text((origin[0] + 8, origin[1] + 50), "z, into the surface", BLUE)
    d.text((origin[0] - 10, origin[1] - 22), "texture pixel (0, 0): its centre is the chart's origin", size=13)
    foot = (400.0, 235.0)
    d.line(foot, (foot[0] + 10, foot[1] - 75), INK, 2, head=True)
    d.dot(foot)
    d.text((foot[0] + 16, foot[1] - 50), "normal, to the sensor")
    sensor = (320.0, 40.0)
    d.polygon([(295, 20), (345, 20), (345, 48), (295, 48)], "white")
    d.polygon([(308, 48), (332, 48), (338, 60), (302, 60)], "white")
    d.text((sensor[0] + 35, sensor[1]), "sensor")
    d.text((320, 316), "seen from the sensor the picture is not mirrored", anchor="middle", size=13)
    return d


def draw_overlap_error() -> Drawing:
    """Overlap error is positive where b lies nearer to the sensor than a."""
    d = Drawing(640, 280)
    d.polygon([(295, 15), (345, 15), (345, 43), (295, 43)], "white")
    d.polygon([(308, 43), (332, 43), (338, 55), (302, 55)], "white")
    d.text((355, 38), "sensor of a")
    grid = [60 + 4 * i for i in range(131)]
    a = [(x, 200 + 12 * math.sin((x - 60) / 110)) for x in grid]
    b = [(x, y - 26 * math.cos((x - 60) / 520 * math.pi)) for x, y in a]
    d.curve(a, BLUE, 2.5)
    d.curve(b, RED, 2.5, "7 4")
    d.text((592, a[-1][1] + 5), "a", BLUE)
    d.text((592, b[-1][1] + 5), "b", RED)
    for index, sign, word in ((20, "+", "b is nearer: positive"), (112, "-", "b is farther: negative")):
        d.line(a[index], b[index], INK, 1.5, head=True)
        side = (a[index][0] + (8 if sign == "+" else -8), min(a[index][1], b[index][1]) - 22)
        d.text(side, word, anchor="start" if sign == "+" else "end", size=13)
    d.text((320, 268), "measured along the normal of a", anchor="middle", size=13)
    return d


FIGURES = {
    "frames": draw_frames,
    "pixels": draw_pixels,
    "phase": draw_phase,
    "chart": draw_chart,
    "overlap_error": draw_overlap_error,
}


def main(folder: Path) -> None:
    """Write all figures into a folder."""
    for name, draw in FIGURES.items():
        (folder / f"{name}.svg").write_text(draw().svg(), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
