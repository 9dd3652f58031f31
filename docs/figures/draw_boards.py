"""Draws the boards of docs/formats.md as SVG: python docs/figures/draw_boards.py [FOLDER]."""

from __future__ import annotations

import sys
from pathlib import Path

from draw_conventions import BLUE, FAINT, INK, RED, Drawing
from planish.sensing.capture.board import Board, board_points, parse_board

SCHEMA = "planish.board/1"
#: The boards of the figure, pitches in its own pixels.
BOARDS = {
    '"chessboard", "corners": [4, 3]': {"kind": "chessboard", "corners": [4, 3], "pitch_mm": 40},
    '"charuco", "squares": [5, 4]': {"kind": "charuco", "squares": [5, 4], "pitch_mm": 40, "marker_mm": 28},
    '"circles", "circles": [4, 3]': {"kind": "circles", "circles": [4, 3], "pitch_mm": 50, "diameter_mm": 26},
    '"asymmetric_circles", "circles": [3, 4]': {
        "kind": "asymmetric_circles",
        "circles": [3, 4],
        "pitch_mm": 32,
        "diameter_mm": 26,
    },
}
PANEL = (370, 260)


def square(d: Drawing, x: float, y: float, side: float, fill: str, stroke: str) -> None:
    """Draw a square by its upper left corner."""
    d.polygon([(x, y), (x + side, y), (x + side, y + side), (x, y + side)], fill, stroke)


def draw_print(d: Drawing, board: Board, left: float, top: float) -> None:
    """Draw what is printed; (left, top) is the place of the board's first point."""
    pitch = board.pitches_mm[0]
    if board.kind in ("circles", "asymmetric_circles"):
        for x, y, _ in board_points(board):
            d.dot((left + x, top + y), INK, board.diameter_mm / 2)
        return
    columns, rows = (n + 1 for n in board.grid)
    marker = 0
    for i in range(rows):
        for j in range(columns):
            x, y = left + pitch * (j - 1), top + pitch * (i - 1)
            dark = (i + j) % 2 == 0
            square(d, x, y, pitch, INK if dark else "white", INK)
            if board.kind == "charuco" and not dark:
                gap = (pitch - board.marker_mm) / 2
                square(d, x + gap, y + gap, board.marker_mm, "#555555", INK)
                d.text((x + pitch / 2 + 6, y + pitch / 2 + 5), str(marker), "white", 13, "middle")
                marker += 1


def draw_boards() -> Drawing:
    """All kinds, with the numbers of their points, the axes and the pitch."""
    d = Drawing(2 * PANEL[0], 2 * PANEL[1])
    for number, (title, content) in enumerate(BOARDS.items()):
        board = parse_board({"schema": SCHEMA, **content}, title)
        across = PANEL[0] * (number % 2)
        left, top = across + 75.0, PANEL[1] * (number // 2) + 90.0
        d.text((across + 25, top - 64), title, size=13)
        draw_print(d, board, left, top)
        points = board_points(board)
        end_x, end_y = left + points[:, 0].max(), top + points[:, 1].max()
        d.line((left, top), (end_x + 62, top), RED, 2, head=True)
        d.text((end_x + 68, top + 5), "x", RED)
        d.line((left, top), (left, end_y + 42), BLUE, 2, head=True)
        d.text((left - 4, end_y + 56), "y", BLUE)
        columns = board.grid[0]
        for index in (0, 1, columns - 1, columns):
            x, y, _ = points[index]
            aside = (4.0, -5.0)
            if board.kind in ("chessboard", "charuco"):
                square(d, left + x + 2, top + y - 15, 11, "white", "white")
            else:
                aside = (10.0, -13.0)
            d.text((left + x + aside[0], top + y + aside[1]), str(index), RED, 12)
            d.dot((left + x, top + y), RED, 4)
        # One pitch along x; of the asymmetric grid, half the distance of discs in a row.
        pitch = board.pitches_mm[0]
        below = end_y + (pitch + 12 if board.kind in ("chessboard", "charuco") else 30)
        d.line((end_x - pitch, below), (end_x, below), FAINT, 2)
        for x in (end_x - pitch, end_x):
            d.line((x, below - 5), (x, below + 5), FAINT, 2)
        d.text((end_x - pitch / 2, below + 17), "pitch", FAINT, 12, "middle")
    return d


def main(folder: Path) -> None:
    """Write the figure into a folder."""
    (folder / "boards.svg").write_text(draw_boards().svg(), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
