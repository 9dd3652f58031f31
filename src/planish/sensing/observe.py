"""What each camera saw: projector positions per axis, texture, noise, and what its images say about themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import BoundedSemaphore

import numpy as np
from numpy.typing import NDArray

from planish.measurement import Finding, Map, NoiseModel, View
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import Layout
from planish.sensing.checks.images import check_images
from planish.sensing.decode import DecodeOptions, PhaseMap, decode
from planish.sensing.decode.average import mean_image
from planish.sensing.decode.gray import gray_offset, gray_positions
from planish.sensing.decode.gray_edges import decode_gray_edges
from planish.sensing.noise.estimate import estimate_noise, full_scale
from planish.sensing.patterns.entries import Axis
from planish.sensing.points.correlate import temporal_view
from planish.sensing.waveform.response import gamma_finding


@dataclass(frozen=True)
class Observation:
    """One camera's share of a capture.

    Parameters
    ----------
    phases : dict of PhaseMap
        Per projector axis; empty for statistical patterns.
    view : View
        White, mean and modulation.
    findings : tuple of Finding
        What the images say about themselves.
    patterns : tuple of ndarray (H, W)
        The images of statistical patterns, which only both cameras together can make use of.
    excluded : ndarray (H, W) bool or None
        Pixels that the capture's mask excludes.
    """

    phases: dict[Axis, PhaseMap]
    view: View
    findings: tuple[Finding, ...] = ()
    patterns: tuple[GreyImage, ...] = ()
    excluded: NDArray[np.bool_] | None = None

    def without(self, pixels: NDArray[np.bool_]) -> Observation:
        """Return the observation with `pixels` (H, W) masked."""
        masked = with_phases(self, lambda phase: phase.without(pixels, "masked"))
        # Pixels that never change have no partner in the other camera.
        patterns = tuple(np.where(pixels, np.zeros((), image.dtype), image) for image in self.patterns)
        return replace(masked, patterns=patterns, excluded=pixels)


@dataclass(frozen=True)
class _Stack:
    """The images of one camera, their noise, and the positions by Gray code per axis."""

    images: Sequence[GreyImage]
    saturation: float
    noise: NoiseModel
    gray: dict[Axis, Map]
    subject: str


def observe(
    take: Callable[[str], Sequence[GreyImage]],
    cameras: Sequence[str],
    layout: Layout,
    options: DecodeOptions,
    subject: str,
    threads: int,
) -> dict[str, Observation]:
    """Return what each camera saw, the cameras worked on side by side.

    Parameters
    ----------
    take : callable
        Returns the images (H, W) of a camera in the order of the sequence, once they are read.
    cameras : sequence of str
        Names.
    layout : Layout
        What the images show.
    options : DecodeOptions
        Limits.
    subject : str
        Named in errors.
    threads : int
        Number of threads; the result does not depend on it.
    """
    slots = BoundedSemaphore(threads)

    def stack(name: str) -> _Stack:
        images = take(name)
        with slots:
            return _stack(name, images, layout, subject, threads)

    def check(name: str) -> tuple[Finding, ...]:
        seen = stacks[name].result()
        with slots:
            return check_images(seen.images, (layout,), seen.noise, seen.saturation, name, subject, threads)

    def see(name: str) -> Observation:
        own, shift = stacks[name].result(), offsets.result()
        with slots:
            return _observe(name, own, layout, shift, options, threads)

    # A worker for each task, for tasks wait for each other; `slots` limits how many work at a time.
    with ThreadPoolExecutor(3 * len(cameras) + 1) as pool:
        stacks = {name: pool.submit(stack, name) for name in cameras}
        checks = {name: pool.submit(check, name) for name in cameras}
        offsets = pool.submit(_gray_offsets, stacks, layout, subject)
        seen = {name: pool.submit(see, name) for name in cameras}
        # First what the images say about themselves: it explains why they cannot be decoded.
        findings = {name: checks[name].result() for name in cameras}
        found = {name: seen[name].result() for name in cameras}
    return {name: replace(item, findings=(*findings[name], *item.findings)) for name, item in found.items()}


def _stack(name: str, images: Sequence[GreyImage], layout: Layout, subject: str, threads: int) -> _Stack:
    saturation = full_scale(images, layout)
    noise = estimate_noise(images, layout, saturation)
    gray = {
        code.axis: gray_positions(images, code, layout, threads)
        for code in layout.codes
        if code.gray is not None and code.periods
    }
    return _Stack(images, saturation, noise, gray, f"{subject}: camera {name}")


def _gray_offsets(stacks: Mapping[str, Future[_Stack]], layout: Layout, subject: str) -> dict[Axis, float]:
    offsets: dict[Axis, float] = {}
    for code in layout.codes:
        if code.gray is not None and code.periods:
            # All cameras together: they would differ by a period if each had its own.
            seen = [future.result() for future in stacks.values()]
            offsets[code.axis] = gray_offset([(s.images, s.gray[code.axis]) for s in seen], code, subject)
    return offsets


def _observe(
    name: str, stack: _Stack, layout: Layout, offsets: Mapping[Axis, float], options: DecodeOptions, threads: int
) -> Observation:
    if layout.statistical:
        return _observe_patterns(stack, layout, threads)
    phases, means, modulations, counts = {}, [], [], []
    for code in layout.codes:
        if not code.periods:
            alone = decode_gray_edges(stack.images, code, layout, stack.noise, stack.saturation, stack.subject, threads)
            phases[code.axis], mean, modulation, count = alone
            means.append(mean)
            modulations.append(modulation)
            counts.append(count)
            continue
        coarse, offset = stack.gray.get(code.axis), offsets.get(code.axis, 0.0)
        found = decode(stack.images, code, stack.noise, stack.saturation, options, threads, coarse, offset)
        phases[code.axis], mean, modulation = found
        means.append(mean)
        modulations.append(modulation)
        counts.append(len(code.phase_images))
    view = View(
        _white(stack.images, layout),
        _average(means, counts),
        _average(modulations, counts),
        sum(counts),
        stack.noise,
        stack.saturation,
    )
    gamma = gamma_finding(stack.images, layout, stack.noise, stack.saturation, name)
    return Observation(phases, view, () if gamma is None else (gamma,))


def _observe_patterns(stack: _Stack, layout: Layout, threads: int) -> Observation:
    patterns = tuple(stack.images[i] for i in layout.statistical)
    view = temporal_view(patterns, stack.noise, stack.saturation, threads)
    return Observation({}, replace(view, white=_white(stack.images, layout)), patterns=patterns)


def _average(maps: Sequence[Map], counts: Sequence[int]) -> Map:
    if len(maps) == 1:
        return maps[0]
    return np.asarray(np.average(maps, axis=0, weights=counts), np.float32)


def _white(images: Sequence[GreyImage], layout: Layout) -> Map | None:
    if not layout.white:
        return None
    white = mean_image(images, layout.white)
    if layout.black:
        white -= mean_image(images, layout.black)
    return white


def with_phases(observation: Observation, change: Callable[[PhaseMap], PhaseMap]) -> Observation:
    """Return the observation with each of its PhaseMaps changed."""
    return replace(observation, phases={axis: change(phase) for axis, phase in observation.phases.items()})
