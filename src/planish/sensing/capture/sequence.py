"""What the images of a sequence are good for: phase steps by period, Gray bits, white and black; checked for gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planish.errors import InputError
from planish.sensing.capture.manifest import Manifest
from planish.sensing.capture.unwrapping import BEST_NOISE, Ladder, Level, candidates, plan_levels
from planish.sensing.patterns.entries import Axis, Entry, Gray, Phase, Statistical


@dataclass(frozen=True)
class PeriodSteps:
    """The phase steps of one period: `images[k]` is the index in the sequence of step k."""

    period_px: float
    sign: int
    images: tuple[int, ...]
    wave: str = "sine"

    @property
    def angles(self) -> np.ndarray:
        """Angles (steps,) [rad]: step k shows A + B cos(phi - angle_k)."""
        steps = len(self.images)
        return self.sign * 2 * np.pi * np.arange(steps) / steps


@dataclass(frozen=True)
class GrayCode:
    """Gray bits from the most significant to the least: indices in the sequence; -1 = no inverse image."""

    cell_px: float
    images: tuple[int, ...]
    inverse: tuple[int, ...]


@dataclass(frozen=True)
class AxisCode:
    """How a sequence encodes the projector position along one axis.

    Parameters
    ----------
    axis : "u" or "v"
        The projector axis.
    periods : tuple of PeriodSteps
        From the longest period to the shortest; none where the Gray code stands alone.
    gray : GrayCode or None
        Without it the periods together are absolute.
    extent_px : float or None
        Projector pixels along the axis, where known.
    ladder : Ladder or None
        How the periods are unwrapped; None where there are none.
    """

    axis: Axis
    periods: tuple[PeriodSteps, ...]
    gray: GrayCode | None
    extent_px: float | None
    ladder: Ladder | None = None

    @property
    def phase_images(self) -> tuple[int, ...]:
        """Indices of all phase images."""
        return tuple(index for period in self.periods for index in period.images)


@dataclass(frozen=True)
class Layout:
    """What the images of one exposure are good for.

    Parameters
    ----------
    codes : tuple of AxisCode
        One per projector axis that is encoded, "u" first.
    statistical : tuple of int
        Indices of the images of statistical patterns.
    white, black : tuple of int
        Indices of the images under full and no projection.
    exposure_ms : float or None
        Exposure time, where the sequence is repeated with several.
    """

    codes: tuple[AxisCode, ...]
    statistical: tuple[int, ...]
    white: tuple[int, ...]
    black: tuple[int, ...]
    exposure_ms: float | None

    @property
    def phase_images(self) -> tuple[int, ...]:
        """Indices of the phase images of all axes."""
        return tuple(index for code in self.codes for index in code.phase_images)

    @property
    def periods(self) -> tuple[PeriodSteps, ...]:
        """The phase steps of all axes."""
        return tuple(period for code in self.codes for period in code.periods)


def read_layouts(
    manifest: Manifest, subject: str, projector_size_px: tuple[int, int] | None = None
) -> tuple[Layout, ...]:
    """Return the layouts of a manifest's sequence, one per exposure from the longest to the shortest.

    Parameters
    ----------
    manifest : Manifest
        Its `projector_px` goes before `projector_size_px`.
    subject : str
        Named in errors.
    projector_size_px : tuple of int or None
        (width, height) of the rig's projector.

    Raises
    ------
    InputError
        Where nothing encodes a position, steps or bits are missing or given twice, or nothing tells which fringe is
        which.
    """
    entries = list(enumerate(manifest.sequence))
    exposures = {entry.exposure_ms for _, entry in entries}
    if None in exposures and len(exposures) > 1:
        raise InputError(f"{subject}: sequence", "some entries have an exposure_ms, some have none", "all or none")
    size = manifest.projector_px or projector_size_px
    longest_first = sorted(exposures, key=lambda exposure: -(exposure or 0.0))
    return tuple(
        _layout([(i, e) for i, e in entries if e.exposure_ms == exposure], exposure, subject, size)
        for exposure in longest_first
    )


def _layout(
    entries: list[tuple[int, Entry]], exposure: float | None, subject: str, size: tuple[int, int] | None
) -> Layout:
    codes = []
    for axis in ("u", "v"):
        phases = [(i, e) for i, e in entries if isinstance(e, Phase) and e.axis == axis]
        grays = [(i, e) for i, e in entries if isinstance(e, Gray) and e.axis == axis]
        if phases or grays:
            extent = None if size is None else float(size[0 if axis == "u" else 1])
            codes.append(_axis_code(axis, phases, grays, extent, subject))
    statistical = tuple(i for i, e in entries if isinstance(e, Statistical))
    if not codes and not statistical:
        raise InputError(
            f"{subject}: sequence",
            "nothing that encodes a position",
            "all steps of at least one fringe period, Gray bits, or statistical patterns",
        )
    if codes and statistical:
        raise InputError(f"{subject}: sequence", "statistical patterns and fringes or Gray bits", "one or the other")
    white = tuple(i for i, e in entries if e.role == "white")
    return Layout(tuple(codes), statistical, white, tuple(i for i, e in entries if e.role == "black"), exposure)


def _axis_code(
    axis: Axis,
    phases: list[tuple[int, Phase]],
    grays: list[tuple[int, Gray]],
    extent: float | None,
    subject: str,
) -> AxisCode:
    periods = tuple(_period(subject, p, phases) for p in sorted({e.period_px for _, e in phases}, reverse=True))
    gray = _gray(subject, grays) if grays else None
    return make_axis_code(axis, periods, gray, extent, subject)


def make_axis_code(
    axis: Axis, periods: tuple[PeriodSteps, ...], gray: GrayCode | None, extent_px: float | None, subject: str
) -> AxisCode:
    """Return the code with the ladder of its periods.

    Raises
    ------
    InputError
        Where nothing tells which fringe is which; it names `subject`.
    """
    ladder = _ladder(periods, gray, extent_px, subject) if periods else None
    return AxisCode(axis, periods, gray, extent_px, ladder)


def _ladder(periods: tuple[PeriodSteps, ...], gray: GrayCode | None, extent: float | None, subject: str) -> Ladder:
    lengths, steps = [p.period_px for p in periods], [len(p.images) for p in periods]
    ladder = plan_levels(lengths, steps, extent, None if gray is None else gray.cell_px)
    if ladder is None and gray is not None:
        raise InputError(
            f"{subject}: sequence",
            f"Gray cells of {gray.cell_px:g} px are longer than the longest period, {_longest(lengths)}",
            "cells of one period or less (half a period is robust)",
        )
    if ladder is None:
        raise InputError(
            f"{subject}: sequence",
            f"the longest period is {_longest(lengths)} of {extent:g} projector px and there is no Gray code",
            "a period or beat as long as the projector, or Gray bits, to tell the fringes apart",
        )
    if ladder.noise_limit < BEST_NOISE:
        raise InputError(
            f"{subject}: sequence",
            f"{' to '.join(map(str, ladder.levels))} needs noise below {ladder.noise_limit:.1%} of the amplitude",
            f"periods between: images with a noise of {BEST_NOISE:.0%} of the amplitude must tell the fringes apart",
        )
    return ladder


def _longest(periods_px: list[float]) -> str:
    level: Level = candidates(periods_px)[0]
    return f"{max(periods_px):g}" if level.period_px <= max(periods_px) else str(level)


def _period(subject: str, period_px: float, phases: list[tuple[int, Phase]]) -> PeriodSteps:
    found = [(i, e) for i, e in phases if e.period_px == period_px]
    steps, sign = found[0][1].steps, found[0][1].sign
    by_step = {e.step: i for i, e in found}
    complete = len(found) == len(by_step) == steps
    if not complete or any((e.steps, e.sign) != (steps, sign) for _, e in found):
        raise InputError(
            f"{subject}: sequence",
            f"period {period_px:g} px has steps {sorted(e.step for _, e in found)} of {steps}",
            f"each step 0 ... {steps - 1} once, with one number of steps and one sign",
        )
    return PeriodSteps(period_px, sign, tuple(by_step[k] for k in range(steps)), found[0][1].wave)


def _gray(subject: str, grays: list[tuple[int, Gray]]) -> GrayCode:
    cells = {e.cell_px for _, e in grays}
    direct = {e.bit: i for i, e in grays if not e.inverse}
    inverse = {e.bit: i for i, e in grays if e.inverse}
    bits = max(e.bit for _, e in grays) + 1
    if len(cells) > 1 or len(direct) + len(inverse) != len(grays) or sorted(direct) != list(range(bits)):
        raise InputError(
            f"{subject}: sequence",
            f"Gray bits {sorted(e.bit for _, e in grays if not e.inverse)} with cells of {sorted(cells)} px",
            f"each bit 0 ... {bits - 1} once (its inverse at most once), all with one cell_px",
        )
    order = range(bits - 1, -1, -1)
    return GrayCode(cells.pop(), tuple(direct[b] for b in order), tuple(inverse.get(b, -1) for b in order))
