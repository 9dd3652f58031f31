"""`planish convert-rig`: calibrations from and to planish, OpenCV and MATLAB."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from planish.cli import console
from planish.cli.patterns import parse_size
from planish.errors import InputError
from planish.geometry import rotation_angle
from planish.rig import Camera, Rig, write_rig
from planish.rig.exchange.common import device_text
from planish.rig.files import import_rig
from planish.rig.parameters import DISTORTION


def describe_rig(rig: Rig) -> list[str]:
    """Return what the rig holds, line by line: devices, baselines, covariance."""
    lines = [f"{device_text(name)}: {_describe_camera(device)}" for name, device in rig.devices.items()]
    (first, camera), *others = rig.devices.items()
    for name, device in others:
        baseline = float(np.linalg.norm(device.center_sensor - camera.center_sensor))
        turn = np.degrees(rotation_angle(device.T_camera_sensor @ np.linalg.inv(camera.T_camera_sensor)))
        lines.append(f"{device_text(first)} to {device_text(name)}: {baseline:.3f} mm, turned by {turn:.3f} deg")
    if rig.covariance is None:
        lines.append("no covariance")
    else:
        lines.append(f"covariance of {len(rig.covariance_parameters)} parameters")
    return lines


def _describe_camera(camera: Camera) -> str:
    K = camera.K
    skew = f", skew {K[0, 1]:.3f}" if K[0, 1] else ""
    used = [name for name, value in zip(DISTORTION, camera.distortion, strict=True) if value]
    return (
        f"{camera.size_px[0]} x {camera.size_px[1]} px, focal length {K[0, 0]:.3f}, {K[1, 1]:.3f} px, "
        f"principal point {K[0, 2]:.3f}, {K[1, 2]:.3f}{skew}; distortion {' '.join(used) or 'none'}"
    )


def convert_rig(
    files: Annotated[
        list[Path], typer.Argument(metavar="IN...", help="rig.json, MAT-file, or the files of one OpenCV calibration.")
    ],
    out: Annotated[Path, typer.Option(help="File to write: .json, .yml, .yaml, .xml (OpenCV) or .mat (MATLAB).")],
    size: Annotated[str | None, typer.Option(help="Size of the images, where IN does not tell it: 2048x1536.")] = None,
    projector_size: Annotated[str | None, typer.Option(help="Size of the projector, likewise.")] = None,
    variable: Annotated[str | None, typer.Option(help="Variable of a MAT-file with several calibrations.")] = None,
    devices: Annotated[
        str | None, typer.Option(help="What a file of OpenCV or MATLAB is to hold: A,B or A,projector or A.")
    ] = None,
    frame: Annotated[
        str | None, typer.Option(help="Camera whose frame becomes the sensor frame, A or B; default: as in IN.")
    ] = None,
) -> None:
    """Convert a calibration, and say what was understood, what was converted and what is lost."""
    size_px = None if size is None else parse_size(size, "--size")
    projector_px = None if projector_size is None else parse_size(projector_size, "--projector-size")
    rig, source, notes = import_rig(files, size_px, projector_px, variable)
    if frame is not None:
        rig = rig.in_frame_of(frame)
    chosen = None if devices is None else tuple(part.strip() for part in devices.split(","))
    if frame is not None and out.suffix.lower() != ".json" and frame != (chosen or tuple(rig.cameras))[0]:
        raise InputError("--frame", f"found '{frame}'", "a .json file: others have the frame of their first camera")
    lost = write_rig(rig, out, chosen)
    for line in (*describe_rig(rig), *(f"from {source}: {note}" for note in notes)):
        typer.echo(line)
    for note in lost:
        console.print("warning:", style="bold yellow", end=" ")
        console.print(f"{out}: {note}", highlight=False, markup=False, soft_wrap=True)


def register_command(app: typer.Typer) -> None:
    """Add the command."""
    app.command("convert-rig")(convert_rig)
