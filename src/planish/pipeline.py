"""The main jobs, one line per stage."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from planish.errors import InputError
from planish.measurement import Measurement
from planish.options import Options, thread_count
from planish.sensing.capture import Capture, GreyImage
from planish.sensing.correspond import correspond
from planish.sensing.decode import DecodeOptions, PhaseMap, decode_views
from planish.sensing.reject import RejectOptions, reject_edges, reject_points
from planish.sensing.sequence import read_layout
from planish.sensing.triangulate import triangulate


class MeasureOptions(Options):
    """Options of `measure`.

    Parameters
    ----------
    organise_on : "A" or "B"
        The camera whose pixel grid organises the measurement.
    texture_views : tuple of "A", "B"
        Cameras whose images may serve as texture.
    decode, reject
        Options of these stages.
    """

    organise_on: Literal["A", "B"] = "A"
    texture_views: tuple[Literal["A", "B"], ...] = Field(default=("A", "B"), min_length=1)
    decode: DecodeOptions = DecodeOptions()
    reject: RejectOptions = RejectOptions()


def measure(capture: Capture, options: MeasureOptions | None = None, threads: int | None = None) -> Measurement:
    """Return the textured 3D measurement of one capture.

    Parameters
    ----------
    capture : Capture
        Manifest and place of the images.
    options : MeasureOptions
        Default: all defaults.
    threads : int or None
        Number of threads; the result does not depend on it.

    Raises
    ------
    InputError
        Where manifest, rig or images are unusable; the message names the file.
    """
    options, threads = options or MeasureOptions(), thread_count(threads)
    rig = capture.load_rig(options.organise_on)
    own, other = options.organise_on, rig.other(options.organise_on)
    if other is None or "B" not in capture.cameras:
        raise InputError(capture.path, f"one camera ({', '.join(rig.cameras)})", "images and calibration of A and B")
    projector_px = None if rig.projector is None else rig.projector.size_px
    layout = read_layout(capture.manifest, str(capture.path), projector_px)
    images = {name: _read_checked(capture, name, rig.cameras[name].size_px, threads) for name in (own, other)}
    phases = decode_views(images, layout, options.decode, str(capture.path), threads)
    phases = {name: _masked(capture, name, phase) for name, phase in phases.items()}
    phases = {name: reject_edges(phase, options.reject, threads) for name, phase in phases.items()}
    pairs = correspond(phases[own], phases[other], rig.cameras[own], rig.cameras[other], threads)
    found = triangulate(pairs, rig.cameras[own], rig.cameras[other], threads)
    rejected = reject_points(
        found, phases[own], rig.cameras[own], rig.projector, capture.manifest.volume_mm, options.reject, threads
    )
    invalid = rejected != 0
    for array in (found.points_sensor, found.sigma_mm, pairs.pixel_px):
        array[invalid] = np.nan
    return Measurement(
        name=capture.name,
        organised_on=own,
        rig=rig,
        points_sensor=found.points_sensor,
        sigma_mm=found.sigma_mm,
        rejected=rejected,
        correspondence_px=pairs.pixel_px,
        views={name: phases[name].view for name in sorted(phases)},
        texture_views=tuple(options.texture_views),
        resampled=False,
    )


def _read_checked(capture: Capture, camera: str, size_px: tuple[int, int], threads: int) -> list[GreyImage]:
    images = capture.read_images(camera, threads)
    found = (images[0].shape[1], images[0].shape[0])
    if found != size_px:
        raise InputError(
            capture.image_path(camera, 0),
            f"is {found[0]} x {found[1]} px",
            f"{size_px[0]} x {size_px[1]} px, as camera {camera} of the rig",
        )
    return images


def _masked(capture: Capture, camera: str, phase: PhaseMap) -> PhaseMap:
    mask = capture.read_mask(camera)
    if mask is None:
        return phase
    if mask.shape != phase.position_px.shape:
        raise InputError(
            f"{capture.path}: mask.{camera}",
            f"is {mask.shape[1]} x {mask.shape[0]} px",
            f"the size of the images, {phase.position_px.shape[1]} x {phase.position_px.shape[0]} px",
        )
    return phase.without(~mask, "masked")
