"""`planish simulate`: render a scene of the catalogue into captures with known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from planish.cli import console
from planish.sensing.patterns import named_sequence
from planish.simulation.scenes import SCENES, Background, make_scene
from planish.simulation.writing import write_scene


def simulate(
    scene: Annotated[str, typer.Argument(help=f"One of: {', '.join(SCENES)}.")],
    out: Annotated[Path, typer.Option(help="Folder for the captures and truth.json.")],
    seed: Annotated[int, typer.Option(help="Everything random follows from it.")] = 0,
    captures: Annotated[int | None, typer.Option(help="Number of captures; default: the scene's own.")] = None,
    grain: Annotated[float | None, typer.Option(help="Rms contrast of the grain, for example 0.005; 0 = none.")] = None,
    texture_density: Annotated[float, typer.Option(help="Factor on the number of scratches, specks, smudges.")] = 1.0,
    width_scale: Annotated[float, typer.Option(help="Camera resolution against 1388 x 1038 px.")] = 1.0,
    bits: Annotated[int, typer.Option(help="8 or 16.")] = 8,
    sequence: Annotated[str, typer.Option(help="reference or gray.")] = "reference",
    exposure: Annotated[float, typer.Option(help="Factor on the light; above 1.4 white metal saturates.")] = 1.0,
    gamma: Annotated[float, typer.Option(help="Camera gamma.")] = 1.0,
    background: Annotated[bool, typer.Option(help="A textured background that does not move with the part.")] = False,
    true_points: Annotated[bool, typer.Option(help="Write the true point of every pixel.")] = True,
    threads: Annotated[int | None, typer.Option(help="Threads; the bytes do not depend on it.")] = None,
) -> None:
    """Render SCENE as the reference sensor would capture it, with its truth."""
    what = make_scene(
        scene, seed, captures, grain=grain, texture_density=texture_density, scale=width_scale, bits=bits
    )  # fmt: skip
    what = replace(
        what,
        sequence=tuple(named_sequence(sequence)),
        sensor=replace(what.sensor, exposure=exposure, gamma=gamma),
        background=Background() if background else None,
    )
    with console.status("") as status:
        folders = write_scene(
            what, out, true_points=true_points, threads=threads,
            progress=lambda name: status.update(f"rendering {name}"),
        )  # fmt: skip
    console.print(f"{len(folders)} captures of '{scene}' in {out}, truth in {out / 'truth.json'}", highlight=False)


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(simulate)
