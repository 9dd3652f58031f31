"""`planish simulate`: render a scene of the catalogue into captures with known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from planish import storage
from planish.cli import console
from planish.cli.patterns import parse_axes, parse_numbers
from planish.errors import InputError
from planish.sensing.capture.manifest import Manifest
from planish.sensing.patterns.entries import Entry
from planish.sensing.patterns.sequences import PROJECTOR_PX, SEQUENCES, named_sequence, with_exposures
from planish.simulation.highlights import with_highlights
from planish.simulation.scenes import SCENES, Background, make_scene
from planish.simulation.writing import write_scene


def read_sequence(text: str, axes: str) -> list[Entry]:
    """Return the sequence of a coding's name, or of a capture.json such as `planish patterns` writes."""
    if not text.endswith(".json"):
        return named_sequence(text, PROJECTOR_PX, axes=parse_axes(axes))
    manifest = Manifest.parse(storage.read_json(Path(text)), text)
    if manifest.projector_px not in (None, PROJECTOR_PX):
        raise InputError(f"{text}: projector_px", f"found {manifest.projector_px}", f"{PROJECTOR_PX} of the simulator")
    return list(manifest.sequence)


def simulate(
    scene: Annotated[str, typer.Argument(help=f"One of: {', '.join(SCENES)}.")],
    out: Annotated[Path, typer.Option(help="Folder for the captures and truth.json.")],
    seed: Annotated[int, typer.Option(help="Everything random follows from it.")] = 0,
    captures: Annotated[int | None, typer.Option(help="Number of captures; default: the scene's own.")] = None,
    grain: Annotated[float | None, typer.Option(help="Rms contrast of the grain, for example 0.005; 0 = none.")] = None,
    texture_density: Annotated[float, typer.Option(help="Factor on the number of scratches, specks, smudges.")] = 1.0,
    width_scale: Annotated[float, typer.Option(help="Camera resolution against 1388 x 1038 px.")] = 1.0,
    bits: Annotated[int, typer.Option(help="8 or 16.")] = 8,
    sequence: Annotated[
        str, typer.Option(help=f"{', '.join(SEQUENCES)}, or a capture.json of `planish patterns`.")
    ] = "reference",
    axes: Annotated[str, typer.Option(help="Encoded projector axes: u, v or both.")] = "u",
    exposures: Annotated[str | None, typer.Option(help="Exposure times (ms), with commas: all images at each.")] = None,
    exposure: Annotated[
        float, typer.Option(help="Factor on the light of the longest exposure; above 1.4 white metal saturates.")
    ] = 1.0,
    gamma: Annotated[float, typer.Option(help="Camera gamma.")] = 1.0,
    projector_gamma: Annotated[float, typer.Option(help="Projector gamma.")] = 1.0,
    ambient: Annotated[float | None, typer.Option(help="Room light as a share of the projector's.")] = None,
    highlights: Annotated[float, typer.Option(help="Share of the pixels that highlights saturate.")] = 0.0,
    background: Annotated[bool, typer.Option(help="A textured background that does not move with the part.")] = False,
    true_points: Annotated[bool, typer.Option(help="Write the true point of every pixel.")] = True,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
) -> None:
    """Render SCENE as the reference sensor would capture it, with its truth."""
    what = make_scene(
        scene, seed, captures, grain=grain, texture_density=texture_density, scale=width_scale, bits=bits
    )  # fmt: skip
    shown = read_sequence(sequence, axes)
    times = parse_numbers(exposures, "--exposures")
    what = replace(
        what,
        sequence=tuple(shown if times is None else with_exposures(shown, times)),
        sensor=replace(what.sensor, exposure=exposure, gamma=gamma, projector_gamma=projector_gamma),
        light=what.light if ambient is None else replace(what.light, ambient=ambient),
        background=Background() if background else None,
    )
    if highlights:
        what = with_highlights(what, highlights, threads)
    with console.status("") as status:
        folders = write_scene(
            what, out, true_points=true_points, threads=threads,
            progress=lambda name: status.update(f"rendering {name}"),
        )  # fmt: skip
    console.print(f"{len(folders)} captures of '{scene}' in {out}, truth in {out / 'truth.json'}", highlight=False)


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(simulate)
