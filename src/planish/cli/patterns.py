"""`planish patterns`: the images of a coding for a projector, and the capture.json to go with them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from planish.cli import console
from planish.errors import InputError
from planish.sensing.patterns.files import write_patterns
from planish.sensing.patterns.sequences import SEQUENCES, named_sequence, with_exposures

#: Axes by the word of the option.
AXES = {"u": ("u",), "v": ("v",), "both": ("u", "v")}


def parse_size(text: str, option: str = "--projector") -> tuple[int, int]:
    """Return (width, height) of a text such as 1280x800; an error names the option."""
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text.strip().lower())
    if found is None:
        raise InputError(option, f"found '{text}'", "WIDTHxHEIGHT in px, for example 1280x800")
    return int(found[1]), int(found[2])


def parse_numbers(text: str | None, option: str) -> list[float] | None:
    """Return the numbers of a list with commas, None for None."""
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(option, f"found '{text}'", "numbers with commas between them") from None


def parse_axes(text: str) -> tuple[str, ...]:
    """Return the axes of "u", "v" or "both"."""
    if text not in AXES:
        raise InputError("--axes", f"found '{text}'", f"one of {', '.join(AXES)}")
    return AXES[text]


def patterns(
    out: Annotated[Path, typer.Argument(help="Folder for the images to project and capture.json.")],
    coding: Annotated[str, typer.Option(help=f"One of: {', '.join(SEQUENCES)}.")] = "multi-frequency",
    projector: Annotated[str, typer.Option(help="Size of the projector (px).")] = "1280x800",
    axes: Annotated[str, typer.Option(help="Encoded axes: u (columns), v (rows) or both.")] = "u",
    period: Annotated[float | None, typer.Option(help="Finest fringe period (projector px).")] = None,
    periods: Annotated[str | None, typer.Option(help="All periods (projector px), with commas.")] = None,
    steps: Annotated[int | None, typer.Option(help="Phase steps per period, at least 3.")] = None,
    ratio: Annotated[float | None, typer.Option(help="multi-frequency: ratio of successive periods.")] = None,
    count: Annotated[int | None, typer.Option(help="heterodyne: periods; statistical: patterns.")] = None,
    cell: Annotated[float | None, typer.Option(help="gray: length of a cell (projector px).")] = None,
    bits: Annotated[int | None, typer.Option(help="Gray bits; default: as many as needed.")] = None,
    complementary: Annotated[bool | None, typer.Option(help="Gray cells of half a period, not a whole one.")] = None,
    inverses: Annotated[bool | None, typer.Option(help="Each Gray bit with its inverted image.")] = None,
    min_period: Annotated[float | None, typer.Option(help="statistical: finest stripes (projector px).")] = None,
    seed: Annotated[int | None, typer.Option(help="statistical: the patterns follow from it.")] = None,
    sign: Annotated[int | None, typer.Option(help="Direction of the phase steps: 1 or -1.")] = None,
    white: Annotated[bool, typer.Option(help="An image with every pixel on (the texture).")] = True,
    black: Annotated[bool, typer.Option(help="An image with every pixel off (the room light).")] = True,
    exposures: Annotated[str | None, typer.Option(help="Exposure times (ms), with commas: all images at each.")] = None,
    gamma: Annotated[float, typer.Option(help="Gamma of the projector, made up for in the images.")] = 1.0,
    cameras: Annotated[int, typer.Option(help="1 or 2: how many cameras record.")] = 2,
) -> None:
    """Write the images of a coding, in the order of projection, and the capture.json to go with them."""
    given: dict[str, Any] = {
        "period_px": period, "periods_px": parse_numbers(periods, "--periods"), "steps": steps, "ratio": ratio,
        "count": count, "cell_px": cell, "bits": bits, "complementary": complementary, "inverses": inverses,
        "min_period_px": min_period, "seed": seed, "sign": sign,
        "axes": parse_axes(axes),
    }  # fmt: skip
    if cameras not in (1, 2):
        raise InputError("--cameras", f"found {cameras}", "1 or 2")
    size = parse_size(projector)
    options = {key: value for key, value in given.items() if value is not None}
    sequence = [
        entry
        for entry in named_sequence(coding, size, **options)
        if (white or entry.role != "white") and (black or entry.role != "black")
    ]
    if (times := parse_numbers(exposures, "--exposures")) is not None:
        sequence = with_exposures(sequence, times)
    paths = write_patterns(out, sequence, size, ("A", "B")[:cameras], gamma)
    console.print(f"{len(paths)} images of {size[0]} x {size[1]} px and capture.json in {out}", highlight=False)
    typer.echo("\n".join(path.name for path in paths))


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(patterns)
