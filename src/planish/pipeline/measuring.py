"""From a capture to a measurement: measure(), one line per stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from planish.errors import InputError
from planish.execution.libraries import serial_linear_algebra
from planish.measurement import Measurement
from planish.options import Options, thread_count
from planish.rig import Rig
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.manifest import Box, Capture, ImageReader
from planish.sensing.capture.sequence import Layout, read_layouts
from planish.sensing.checks.coverage import check_coverage
from planish.sensing.checks.slips import observe_consistent
from planish.sensing.checks.swapped import check_rig
from planish.sensing.decode import DecodeOptions
from planish.sensing.exposures import merge_exposures, split_exposures
from planish.sensing.observe import Observation, with_phases
from planish.sensing.points.axes import axis_weights
from planish.sensing.points.correlate import CorrelateOptions
from planish.sensing.points.locate import (
    Geometry,
    Located,
    cameras_needed,
    fill_in,
    find_missing,
    locate_between_cameras,
    locate_by_correlation,
    locate_by_projector,
)
from planish.sensing.points.reject import RejectOptions, drop_points, reject_edges, reject_points
from planish.sensing.waveform.straighten import straighten


class MeasureOptions(Options):
    """Options of `measure`.

    Parameters
    ----------
    organise_on : "A" or "B"
        The camera whose pixel grid organises the measurement.
    geometry : "auto", "stereo" or "projector"
        What gives the points: two cameras where both have images, with the projector where the other camera sees
        nothing ("auto"; one camera and the projector where there are images of one), two cameras alone, or the
        organising camera and the projector alone.
    texture_views : tuple of "A", "B"
        Cameras whose images may serve as texture, of those that the points rest on.
    decode, correlate, reject
        Options of these stages.
    """

    organise_on: Literal["A", "B"] = "A"
    geometry: Geometry = "auto"
    texture_views: tuple[Literal["A", "B"], ...] = Field(default=("A", "B"), min_length=1)
    decode: DecodeOptions = DecodeOptions()
    correlate: CorrelateOptions = CorrelateOptions()
    reject: RejectOptions = RejectOptions()


@serial_linear_algebra()
def measure(
    capture: Capture,
    options: MeasureOptions | None = None,
    threads: int | None = None,
    rig: Rig | None = None,
) -> Measurement:
    """Return the textured 3D measurement of one capture.

    Parameters
    ----------
    capture : Capture
        Manifest and place of the images.
    options : MeasureOptions
        Default: all defaults.
    threads : int or None
        Number of threads; the result does not depend on it.
    rig : Rig or None
        Default: the one that the manifest names.

    Raises
    ------
    InputError
        Where manifest, rig or images are unusable; the message names the file.
    """
    options, threads = options or MeasureOptions(), thread_count(threads)
    rig = capture.load_rig(options.organise_on) if rig is None else rig
    own = options.organise_on
    cameras = cameras_needed(rig, capture.cameras, own, options.geometry, str(capture.path))
    views = _texture_views(options, cameras, str(capture.path))
    exposures = _exposures(capture, rig)
    layout = exposures[0].layout
    seen = _observe(capture, exposures, rig, cameras, options, threads)
    seen = _straighten(seen, layout, options.reject, threads)
    located = _locate(seen, rig, layout, capture.manifest.volume_mm, options, str(capture.path), threads)
    rejected = reject_points(
        located.points,
        located.phase,
        rig.cameras[own],
        located.third,
        capture.manifest.volume_mm,
        options.reject,
        threads,
    )
    coverage = check_coverage(rejected, str(capture.path))
    drop_points(located.points, located.correspondence_px, rejected, threads)
    return Measurement(
        name=capture.name,
        organised_on=own,
        rig=rig,
        points_sensor=located.points.points_sensor,
        sigma_mm=located.points.sigma_mm,
        rejected=rejected,
        correspondence_px=located.correspondence_px,
        views={name: seen[name].view for name in sorted(seen)},
        texture_views=views,
        resampled=False,
        findings=(
            *(finding for name in sorted(seen) for finding in seen[name].findings),
            *located.findings,
            coverage,
        ),
        position_px=None if layout.statistical else located.phase.position_px,
        projector_weights=axis_weights(seen[own].phases),
    )


def observe_capture(
    capture: Capture,
    options: MeasureOptions | None = None,
    threads: int | None = None,
    rig: Rig | None = None,
) -> Mapping[str, Observation]:
    """Return what each camera of a capture saw, as `measure` uses it: positions without errors of their wave form.

    Parameters and errors are those of `measure`.
    """
    options, threads = options or MeasureOptions(), thread_count(threads)
    rig = capture.load_rig(options.organise_on) if rig is None else rig
    cameras = cameras_needed(rig, capture.cameras, options.organise_on, options.geometry, str(capture.path))
    exposures = _exposures(capture, rig)
    seen = _observe(capture, exposures, rig, cameras, options, threads)
    return _straighten(seen, exposures[0].layout, options.reject, threads)


def _straighten(
    seen: Mapping[str, Observation], layout: Layout, options: RejectOptions, threads: int
) -> Mapping[str, Observation]:
    own = max(1, threads // len(seen))

    def straight(name: str) -> Observation:
        # Ripples of the fringes' wave form look like jumps: only then are edges looked for.
        cut = partial(reject_edges, options=options, threads=own)
        return with_phases(straighten(seen[name], layout.codes, name), cut)

    with ThreadPoolExecutor(threads) as pool:
        return dict(zip(seen, pool.map(straight, seen), strict=True))


def _locate(
    seen: Mapping[str, Observation],
    rig: Rig,
    layout: Layout,
    volume: Box | None,
    options: MeasureOptions,
    subject: str,
    threads: int,
) -> Located:
    if layout.statistical:

        def locate(item: Mapping[str, Observation]) -> Located:
            return locate_by_correlation(item, rig, options.organise_on, volume, options.correlate, subject, threads)

        located = locate(seen)
        return replace(located, findings=check_rig(seen, located, rig, options.organise_on, subject, threads, locate))
    own, camera, projector = options.organise_on, rig.cameras[options.organise_on], rig.projector
    phases = {name: item.phases for name, item in seen.items()}
    if len(seen) == 1:
        assert projector is not None
        return locate_by_projector(phases[own], camera, projector, options.reject, subject, threads)
    located = locate_between_cameras(phases, rig, own, subject, threads)
    if projector is None or options.geometry == "stereo":
        return replace(located, findings=check_rig(seen, located, rig, own, subject, threads))
    period = min((period.period_px for period in layout.periods), default=None)
    with ThreadPoolExecutor(1) as pool:
        fit = pool.submit(check_rig, seen, located, rig, own, subject, threads)
        filling = find_missing(located, phases[own], camera, projector, period, options.reject, subject, threads)
        # What the projector's ray has to say, its filling in says better.
        rows = fit.result()[:1]
    return fill_in(replace(located, phase=phases[own][located.phase.axis], findings=rows), filling)


def _texture_views(options: MeasureOptions, cameras: tuple[str, ...], subject: str) -> tuple[str, ...]:
    views = tuple(name for name in options.texture_views if name in cameras)
    if not views:
        raise InputError(
            f"{subject}: texture views", ", ".join(options.texture_views), f"a camera in use: {', '.join(cameras)}"
        )
    return views


class _Exposure(NamedTuple):
    time_ms: float
    capture: Capture
    layout: Layout


def _exposures(capture: Capture, rig: Rig) -> list[_Exposure]:
    projector_px = None if rig.projector is None else rig.projector.size_px
    return [
        _Exposure(time_ms, part, read_layouts(part.manifest, str(part.path), projector_px)[0])
        for time_ms, part in split_exposures(capture)
    ]


def _observe(
    capture: Capture,
    exposures: Sequence[_Exposure],
    rig: Rig,
    cameras: tuple[str, ...],
    options: MeasureOptions,
    threads: int,
) -> Mapping[str, Observation]:
    masks = {name: capture.read_mask(name) for name in cameras}
    # One exposure's images at a time are in memory.
    each = [_observe_exposure(exposure, rig, cameras, options, threads) for exposure in exposures]
    times = [exposure.time_ms for exposure in exposures]
    seen = {name: merge_exposures([item[name] for item in each], times) for name in cameras}
    for name, mask in masks.items():
        if mask is not None:
            _require_size(mask, f"{capture.path}: mask.{name}", name, rig.cameras[name].size_px)
            seen[name] = seen[name].without(~mask)
    return seen


def _observe_exposure(
    exposure: _Exposure, rig: Rig, cameras: tuple[str, ...], options: MeasureOptions, threads: int
) -> Mapping[str, Observation]:
    _, capture, layout = exposure
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
