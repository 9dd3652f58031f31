"""What the projector shows: the sequences of all codings, by name.

Every sequence is a pure function of the projector's size, the axes and its own options; what its entries look like
stands in `encode`.
"""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from planish.errors import InputError
from planish.sensing.patterns.encode import (
    axis_of,
    encode,
    entry_label,
    pattern_image,
    projector_image,
    projector_profile,
)
from planish.sensing.patterns.entries import Axis, Black, Entry, Gray, Phase, Statistical, White

__all__ = [
    "PROJECTOR_PX",
    "SEQUENCES",
    "axis_of",
    "encode",
    "entry_label",
    "gray_bits",
    "gray_phase_sequence",
    "gray_sequence",
    "heterodyne_sequence",
    "multi_frequency_sequence",
    "named_sequence",
    "pattern_image",
    "phase_shift_sequence",
    "phase_steps",
    "projector_image",
    "projector_profile",
    "reference_sequence",
    "square_sequence",
    "statistical_sequence",
    "with_exposures",
]

#: A phase needs three steps, a fringe more than two pixels (sampling theorem); the bits that a manifest can describe.
MIN_STEPS, MIN_PERIOD_PX, MAX_BITS = 3, 3.0, 16
#: Absolute periods are longer than the projector by this share.
SPARE = 1 / 32

#: Fringe periods [projector px] of the reference sequence.
REFERENCE_PERIODS_PX = (1280.0, 160.0, 20.0)

Size = tuple[int, int]
Axes = Sequence[Axis]
#: Width and height of the reference sensor's projector.
PROJECTOR_PX = (1280, 800)


def phase_steps(period_px: float, steps: int, axis: Axis = "u", wave: str = "sine", sign: int = 1) -> list[Entry]:
    """Return the entries of one fringe period in equal phase steps.

    Raises
    ------
    InputError
        Where fewer than three steps are asked for, or the projector's pixels cannot show the period.
    """
    if steps < MIN_STEPS:
        raise InputError("steps", f"found {steps}", f"at least {MIN_STEPS}: offset, amplitude and phase are unknown")
    # A square wave's edge can be shown at half pixels (the pixel half on).
    shortest = MIN_PERIOD_PX if wave == "sine" else max(MIN_PERIOD_PX, steps / 2)
    if not shortest <= period_px < np.inf:
        limit = f"at least {shortest:g} projector px for {steps} steps of a {wave} wave"
        raise InputError("period", f"found {period_px:g} projector px", limit)
    values = {"role": "phase", "axis": axis, "period_px": period_px, "steps": steps, "wave": wave, "sign": sign}
    return [Phase.parse(values | {"step": step}, "phase step") for step in range(steps)]


def gray_bits(
    extent_px: float, cell_px: float, axis: Axis = "u", inverses: bool = False, bits: int | None = None
) -> list[Entry]:
    """Return the Gray bits, most significant first, that tell all cells of `cell_px` over `extent_px` pixels apart.

    Raises
    ------
    InputError
        Where `bits` (default: as many as needed) are too few or too many.
    """
    needed = max(1, (int(np.ceil(extent_px / cell_px)) - 1).bit_length())
    bits = needed if bits is None else bits
    if not needed <= bits <= MAX_BITS:
        found = f"found {bits}; {needed} tell cells of {cell_px:g} px over {extent_px:g} projector px apart"
        raise InputError("Gray bits", found, f"as many, and no more than {MAX_BITS}")
    return [
        Gray(role="gray", axis=axis, bit=bit, inverse=inverse, cell_px=cell_px)
        for bit in reversed(range(bits))
        for inverse in ((False, True) if inverses else (False,))
    ]


def reference_sequence(projector_px: Size = PROJECTOR_PX, axes: Axes = ("u",)) -> list[Entry]:
    """Return the sequence of the reference sensor: 12 phase images (three periods, 4 steps each), white, black."""
    return multi_frequency_sequence(projector_px, axes, periods_px=REFERENCE_PERIODS_PX)


def phase_shift_sequence(
    projector_px: Size = PROJECTOR_PX, axes: Axes = ("u",), *, steps: int = 8, sign: int = 1
) -> list[Entry]:
    """Return one period that covers the projector, in `steps` phase steps per axis; white, black.

    It is absolute by itself; the noise of a position is that of a period as long as the projector.
    """
    periods = [(axis, _covering(extent)) for axis, extent in _extents(projector_px, axes)]
    return _closed([entry for axis, period in periods for entry in phase_steps(period, steps, axis, sign=sign)])


def multi_frequency_sequence(
    projector_px: Size = PROJECTOR_PX,
    axes: Axes = ("u",),
    *,
    period_px: float = 20.0,
    steps: int = 4,
    ratio: float = 8.0,
    periods_px: Sequence[float] | None = None,
    sign: int = 1,
) -> list[Entry]:
    """Return a hierarchy of periods per axis, from one that covers the projector to the finest; white, black.

    Parameters
    ----------
    projector_px : tuple of int
        (width, height) of the projector.
    axes : sequence of "u", "v"
        Encoded axes.
    period_px : float
        Finest period.
    steps, sign : int
        Phase steps per period and their direction.
    ratio : float
        Two successive periods differ by about this factor, equally often: the noise of each must decide about the
        whole periods of the next.
    periods_px : sequence of float or None
        All periods instead.
    """
    entries: list[Entry] = []
    for axis, extent in _extents(projector_px, axes):
        periods = _hierarchy(extent, period_px, ratio) if periods_px is None else sorted(set(periods_px), reverse=True)
        if periods[0] < extent:
            found = f"the longest is {periods[0]:g} of {extent} projector px along {axis}"
            raise InputError("periods", found, "a period as long as the projector")
        entries += [entry for period in periods for entry in phase_steps(period, steps, axis, sign=sign)]
    return _closed(entries)


def heterodyne_sequence(
    projector_px: Size = PROJECTOR_PX,
    axes: Axes = ("u",),
    *,
    period_px: float | None = None,
    count: int = 3,
    steps: int = 4,
    periods_px: Sequence[float] | None = None,
    sign: int = 1,
) -> list[Entry]:
    """Return two or three close periods per axis whose beats reach over the projector; white, black.

    Parameters
    ----------
    projector_px : tuple of int
        (width, height) of the projector.
    axes : sequence of "u", "v"
        Encoded axes.
    period_px : float or None
        Finest period, about: it is fitted to the projector. None = 30 px with three periods, 64 px with two, whose
        noise multiplies by the number of fringes (with three by its root).
    count : int
        2 or 3 periods.
    steps, sign : int
        Phase steps per period and their direction.
    periods_px : sequence of float or None
        The periods instead.

    Notes
    -----
    n, n - 1 and n - sqrt(n) fringes over the projector: beats of 1 and sqrt(n) fringes, each of which decides about
    the next with equal safety (Towers, Towers & Jones, Optimum frequency selection in multifrequency interferometry,
    Optics Letters 28, 2003). The beat of the periods a and b is a b / |a - b| px long.
    """
    entries: list[Entry] = []
    for axis, extent in _extents(projector_px, axes):
        if periods_px is None:
            periods = _optimum_periods(extent, period_px or (30.0 if count == 3 else 64.0), count)
        else:
            periods = sorted(set(periods_px), reverse=True)
        beats = [a * b / (a - b) for a, b in itertools.combinations(periods, 2)]
        if len(periods) not in (2, 3) or max(beats) < extent:
            found = f"{', '.join(f'{p:g}' for p in periods)} px with a beat of {max(beats, default=0):.5g} px"
            raise InputError("periods", found, f"two or three whose beat reaches over {extent} projector px ({axis})")
        entries += [entry for period in periods for entry in phase_steps(period, steps, axis, sign=sign)]
    return _closed(entries)


def gray_phase_sequence(
    projector_px: Size = PROJECTOR_PX,
    axes: Axes = ("u",),
    *,
    period_px: float = 20.0,
    steps: int = 4,
    complementary: bool = True,
    inverses: bool = False,
    bits: int | None = None,
    wave: str = "sine",
    sign: int = 1,
) -> list[Entry]:
    """Return per axis the phase steps of one period and the Gray code of its number; white, black.

    Parameters
    ----------
    projector_px : tuple of int
        (width, height) of the projector.
    axes : sequence of "u", "v"
        Encoded axes.
    period_px : float
        Fringe period.
    steps, sign : int
        Phase steps and their direction.
    complementary : bool
        Cells of half a period: the lowest bit is the complementary bit. Otherwise cells of one period.
    inverses : bool
        Each bit with its inverted image.
    bits : int or None
        Number of Gray bits; None = as many as needed.
    wave : "sine" or "square"
        Of the fringes.
    """
    entries: list[Entry] = []
    for axis, extent in _extents(projector_px, axes):
        entries += phase_steps(period_px, steps, axis, wave, sign)
        entries += gray_bits(extent, period_px / 2 if complementary else period_px, axis, inverses, bits)
    return _closed(entries)


def square_sequence(
    projector_px: Size = PROJECTOR_PX,
    axes: Axes = ("u",),
    *,
    period_px: float = 12.0,
    steps: int = 6,
    complementary: bool = True,
    inverses: bool = False,
    bits: int | None = None,
    sign: int = 1,
) -> list[Entry]:
    """Return per axis a square wave shifted in equal steps and its Gray code; white, black: on and off are enough."""
    return gray_phase_sequence(
        projector_px, axes, period_px=period_px, steps=steps, complementary=complementary, inverses=inverses,
        bits=bits, wave="square", sign=sign,
    )  # fmt: skip


def gray_sequence(
    projector_px: Size = PROJECTOR_PX,
    axes: Axes = ("u",),
    *,
    cell_px: float = 1.0,
    inverses: bool = True,
    bits: int | None = None,
) -> list[Entry]:
    """Return the Gray code of every projector pixel (or cell) per axis, with inverses or without; white, black."""
    extents = _extents(projector_px, axes)
    return _closed([entry for axis, extent in extents for entry in gray_bits(extent, cell_px, axis, inverses, bits)])


def statistical_sequence(
    projector_px: Size = PROJECTOR_PX,
    axes: Axes = ("u",),
    *,
    count: int = 24,
    min_period_px: float = 12.0,
    seed: int = 1,
) -> list[Entry]:
    """Return `count` aperiodic patterns along one axis; white, black.

    Raises
    ------
    InputError
        Where both axes are asked for (correlation needs one), or too few patterns.
    """
    if len(axes) != 1:
        raise InputError("axes", "both", "u or v: statistical patterns are correlated along one axis")
    if count < MIN_STEPS:
        raise InputError("count", f"found {count}", f"at least {MIN_STEPS} patterns")
    values = {"role": "statistical", "axis": axes[0], "seed": seed, "min_period_px": min_period_px}
    return _closed([Statistical.parse(values | {"index": k}, "statistical pattern") for k in range(count)])


def with_exposures(sequence: Sequence[Entry], exposures_ms: Sequence[float]) -> list[Entry]:
    """Return the whole sequence once for each exposure time [ms], in their order."""
    if len(set(exposures_ms)) != len(exposures_ms) or not all(0 < e < np.inf for e in exposures_ms):
        raise InputError("exposures", f"found {list(exposures_ms)}", "different times above 0 ms")
    return [entry.model_copy(update={"exposure_ms": float(e)}) for e in exposures_ms for entry in sequence]


#: Sequences by name: functions of the projector's size, the axes and options of their own.
SEQUENCES: dict[str, Callable[..., list[Entry]]] = {
    "reference": reference_sequence,
    "phase-shift": phase_shift_sequence,
    "multi-frequency": multi_frequency_sequence,
    "heterodyne": heterodyne_sequence,
    "gray-phase": gray_phase_sequence,
    "gray": gray_sequence,
    "square": square_sequence,
    "statistical": statistical_sequence,
}


def named_sequence(name: str, projector_px: Size = PROJECTOR_PX, **options: Any) -> list[Entry]:
    """Return a sequence by its name; unknown names and options are errors that list the known ones."""
    if name not in SEQUENCES:
        raise InputError("sequence", f"found '{name}'", f"one of {', '.join(SEQUENCES)}")
    known = [key for key in inspect.signature(SEQUENCES[name]).parameters if key != "projector_px"]
    if unknown := [key for key in options if key not in known]:
        raise InputError(f"sequence '{name}'", f"the options {', '.join(unknown)}", f"some of {', '.join(known)}")
    return SEQUENCES[name](projector_px, **options)


def _closed(entries: list[Entry]) -> list[Entry]:
    return [*entries, White(role="white"), Black(role="black")]


def _extents(projector_px: Size, axes: Axes) -> list[tuple[Axis, int]]:
    sizes: dict[Axis, int] = dict(zip(("u", "v"), projector_px, strict=True))
    if not axes or min(projector_px) < 1:
        raise InputError("projector", f"found {projector_px} px, axes {list(axes)}", "a size and at least one axis")
    return [(axis, sizes[axis]) for axis in axes]


def _covering(extent: float) -> float:
    """Return an absolute period: longer than the projector, so that noise at its rims does not wrap."""
    return float(np.ceil(extent * (1 + SPARE)))


def _hierarchy(extent: float, period_px: float, ratio: float) -> list[float]:
    if not 1 < ratio < np.inf:
        raise InputError("ratio", f"found {ratio:g}", "a number above 1")
    longest = max(_covering(extent), period_px)
    # The spare shall not cost a period.
    levels = max(1, math.ceil(math.log(longest / period_px) / math.log(ratio * (1 + SPARE)) - 1e-9))
    steps = (longest / period_px) ** (1 / levels)
    return list(dict.fromkeys([longest, *(float(round(longest / steps**k)) for k in range(1, levels)), period_px]))


def _optimum_periods(extent: float, period_px: float, count: int) -> list[float]:
    beat = _covering(extent)
    fringes = round(beat / period_px)
    used = [fringes - 1, fringes] if count == 2 else [fringes - round(math.sqrt(fringes)), fringes - 1, fringes]
    if count not in (2, 3) or used[0] < 1 or len(set(used)) != len(used):
        found = f"{count} periods near {period_px:g} px over {extent:g} projector px"
        raise InputError("periods", found, "two or three, several of which fit onto the projector")
    return [beat / n for n in used]
