"""`planish import`: cloud, image and camera of any other scanner to a measurement."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from planish.cli.measure import summary
from planish.errors import InputError
from planish.files.read_cloud import read_ply_points
from planish.rig import read_rig
from planish.sensing.capture.images import read_grey
from planish.sensing.imported.measurement import import_measurement


def import_cloud(
    cloud: Annotated[Path, typer.Option(help="PLY file: one point per pixel, row by row, or unorganised.")],
    image: Annotated[Path, typer.Option(help="Grey image of the camera.")],
    camera: Annotated[Path, typer.Option(help="Calibration whose camera A took the image: rig.json, OpenCV, MATLAB.")],
    out: Annotated[Path, typer.Option(help="Measurement to write (.h5).")],
    name: Annotated[str | None, typer.Option(help="Name of the measurement; default: of the file.")] = None,
) -> None:
    """Make a measurement of a point cloud, an image and a camera."""
    if out.suffix != ".h5":
        raise InputError("--out", f"found '{out}'", "a file name that ends in .h5")
    grey = read_grey(image)
    height, width = grey.shape
    rig = read_rig(camera, (width, height))
    try:
        measurement = import_measurement(name or out.stem, read_ply_points(cloud), grey, rig)
    except InputError as error:
        # The measurement knows the inputs by their roles; the reader knows files.
        files = {"cloud": cloud, "image": image}
        if error.subject in files:
            raise InputError(files[error.subject], error.found, error.expected) from None
        raise
    measurement.save(out)
    typer.echo(summary(measurement))


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command("import")(import_cloud)
