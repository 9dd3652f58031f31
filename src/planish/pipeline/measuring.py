"""From a capture to a measurement: measure(), one line per stage."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.errors import InputError
from planish.measurement import Measurement
from planish.options import Options, thread_count
from planish.rig import Rig
from planish.sensing.capture import Capture, ImageReader
from planish.sensing.checks.coverage import check_coverage
from planish.sensing.checks.slips import observe_consistent
from planish.sensing.checks.swapped import check_rig
from planish.sensing.correspond import correspond
from planish.sensing.decode import DecodeOptions, PhaseMap
from planish.sensing.exposures import merge_exposures, split_exposures
from planish.sensing.images import GreyImage
from planish.sensing.observe import Observation, with_phases
from planish.sensing.reject import RejectOptions, drop_points, reject_edges, reject_points
from planish.sensing.sequence import read_layouts
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
    layouts = read_layouts(
        capture.manifest, str(capture.path), None if rig.projector is None else rig.projector.size_px
    )
    seen = _observe(capture, rig, (own, other), options, threads)
    axis = layouts[0].codes[0].axis
    phase = seen[own].phases[axis]
    pairs = correspond(phase, seen[other].phases[axis], rig.cameras[own], rig.cameras[other], threads)
    found = triangulate(pairs, rig.cameras[own], rig.cameras[other], threads)
    fit = check_rig(seen, pairs, found, rig, (own, other), axis, str(capture.path), threads)
    rejected = reject_points(
        found, phase, rig.cameras[own], rig.projector, capture.manifest.volume_mm, options.reject, threads
    )
    coverage = check_coverage(rejected, str(capture.path))
    drop_points(found, pairs, rejected, threads)
    return Measurement(
        name=capture.name,
        organised_on=own,
        rig=rig,
        points_sensor=found.points_sensor,
        sigma_mm=found.sigma_mm,
        rejected=rejected,
        correspondence_px=pairs.pixel_px,
        views={name: seen[name].view for name in sorted(seen)},
        texture_views=tuple(options.texture_views),
        resampled=False,
        findings=(*(finding for name in sorted(seen) for finding in seen[name].findings), *fit, coverage),
    )


def _observe(
    capture: Capture, rig: Rig, cameras: tuple[str, ...], options: MeasureOptions, threads: int
) -> Mapping[str, Observation]:
    masks = {name: capture.read_mask(name) for name in cameras}
    # One exposure's images at a time are in memory.
    parts = split_exposures(capture)
    each = [_observe_exposure(part, rig, cameras, options, threads) for _, part in parts]
    times = [exposure for exposure, _ in parts]
    seen = {name: merge_exposures([item[name] for item in each], times) for name in cameras}
    for name, mask in masks.items():
        if mask is not None:
            _require_size(mask, f"{capture.path}: mask.{name}", name, rig.cameras[name].size_px)
            seen[name] = with_phases(seen[name], partial(PhaseMap.without, pixels=~mask, reason="masked"))
    cut = partial(reject_edges, options=options.reject, threads=threads)
    return {name: with_phases(item, cut) for name, item in seen.items()}


def _observe_exposure(
    capture: Capture, rig: Rig, cameras: tuple[str, ...], options: MeasureOptions, threads: int
) -> Mapping[str, Observation]:
    projector_px = None if rig.projector is None else rig.projector.size_px
    (layout,) = read_layouts(capture.manifest, str(capture.path), projector_px)
    with ImageReader(capture, cameras, threads) as reader:

        def take(name: str) -> list[GreyImage]:
            images = reader.take(name)
            _require_size(images[0], capture.image_path(name, 0), name, rig.cameras[name].size_px)
            return images

        subject, again = str(capture.path), partial(capture.read_images, threads=threads)
        return observe_consistent(take, again, cameras, layout, options.decode, subject, threads)


def _require_size(
    image: GreyImage | NDArray[np.bool_], subject: Path | str, camera: str, size_px: tuple[int, int]
) -> None:
    found = (image.shape[1], image.shape[0])
    if found != size_px:
        raise InputError(
            subject, f"is {found[0]} x {found[1]} px", f"{size_px[0]} x {size_px[1]} px, as camera {camera} of the rig"
        )
