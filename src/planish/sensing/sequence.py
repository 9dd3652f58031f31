"""What the images of a sequence are good for: phase steps by period, Gray bits, white and black; checked for gaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from planish.errors import InputError
from planish.sensing.capture import Gray, Manifest, Phase

Axis = Literal["u", "v"]


@dataclass(frozen=True)
class PeriodSteps:
    """The phase steps of one period: `images[k]` is the index in the sequence of step k."""

    period_px: float
    sign: int
    images: tuple[int, ...]

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
class Layout:
    """How a sequence encodes the projector position along one axis.

    Parameters
    ----------
    axis : "u" or "v"
        The projector axis.
    periods : tuple of PeriodSteps
        From the longest period to the shortest; at least one.
    gray : GrayCode or None
        Without it the longest period is absolute.
    white, black : tuple of int
        Indices of the images under full and no projection.
    extent_px : float or None
        Projector pixels along the axis, where known.
    """

    axis: Axis
    periods: tuple[PeriodSteps, ...]
    gray: GrayCode | None
    white: tuple[int, ...]
    black: tuple[int, ...]
    extent_px: float | None

    @property
    def phase_images(self) -> tuple[int, ...]:
        """Indices of all phase images."""
        return tuple(index for period in self.periods for index in period.images)


def read_layout(manifest: Manifest, subject: str, projector_size_px: tuple[int, int] | None = None) -> Layout:
    """Return the layout of a manifest's sequence; errors name `subject`.

    Raises
    ------
    InputError
        Where the sequence has no phase images, steps or bits are missing or given twice, or where nothing tells which
        fringe is which.
    """
    entries = manifest.sequence
    axis: Axis = "u" if any(isinstance(e, Phase) and e.axis == "u" for e in entries) else "v"
    phases = [(i, e) for i, e in enumerate(entries) if isinstance(e, Phase) and e.axis == axis]
    grays = [(i, e) for i, e in enumerate(entries) if isinstance(e, Gray) and e.axis == axis]
    if not phases:
        raise InputError(f"{subject}: sequence", "no phase images", "all steps of at least one fringe period")
    size = manifest.projector_px or projector_size_px
    extent = None if size is None else float(size[0 if axis == "u" else 1])
    layout = Layout(
        axis,
        tuple(_period(subject, p, phases) for p in sorted({e.period_px for _, e in phases}, reverse=True)),
        _gray(subject, grays) if grays else None,
        tuple(i for i, e in enumerate(entries) if e.role == "white"),
        tuple(i for i, e in enumerate(entries) if e.role == "black"),
        extent,
    )
    longest = layout.periods[0].period_px
    if layout.gray is None and extent is not None and longest < extent:
        raise InputError(
            f"{subject}: sequence",
            f"the longest period is {longest:g} of {extent:g} projector px and there is no Gray code",
            "a period as long as the projector, or Gray bits, to tell the fringes apart",
        )
    if layout.gray is not None and layout.gray.cell_px > longest:
        raise InputError(
            f"{subject}: sequence",
            f"Gray cells of {layout.gray.cell_px:g} px are longer than the longest period, {longest:g} px",
            "cells of one period or less (half a period is robust)",
        )
    return layout


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
    return PeriodSteps(period_px, sign, tuple(by_step[k] for k in range(steps)))


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
