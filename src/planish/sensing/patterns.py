"""What the projector shows: brightness of each entry of a sequence over the projector's own coordinates.

Phase: I = 1/2 + 1/2 cos(phi - sign 2 pi step / steps), phi = 2 pi u / period_px, u = 0 at the first pixel's centre.
Gray: reflected code g = k ^ (k >> 1) of cell k; cell k starts at projector pixel k cell_px.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from planish.errors import InputError
from planish.geometry import Array
from planish.sensing.entries import Black, Entry, Gray, Phase, Statistical, White
from planish.sensing.statistical import statistical_profile

#: Fringe periods [projector px] of the reference sequence, each shown in REFERENCE_STEPS steps.
REFERENCE_PERIODS_PX = (1280.0, 160.0, 20.0)
REFERENCE_STEPS = 4
#: Cosines this near to zero are the edge of a square wave: the pixel is half on, so that the edge is not displaced.
EDGE = 1e-9


def encode(entry: Entry, coordinate_px: ArrayLike) -> Array:
    """Return the brightness (...,), 0 to 1, that an entry shows at projector coordinates (...,) [px] along its axis."""
    u = np.asarray(coordinate_px, float)
    if isinstance(entry, White):
        return np.ones_like(u)
    if isinstance(entry, Black):
        return np.zeros_like(u)
    if isinstance(entry, Phase):
        return _encode_phase(entry, u)
    if isinstance(entry, Statistical):
        return statistical_profile(u, entry.index, entry.seed, entry.min_period_px)
    return _encode_gray(entry, u)


def projector_profile(entry: Entry, projector_px: tuple[int, int]) -> Array:
    """Return the brightness (n,) of every projector column (axis u) or row (axis v) of a (width, height) projector."""
    return encode(entry, np.arange(projector_px[0] if axis_of(entry) == "u" else projector_px[1]))


def projector_image(entry: Entry, projector_px: tuple[int, int]) -> Array:
    """Return the whole projected image (H, W), 0 to 1."""
    width, height = projector_px
    profile = projector_profile(entry, projector_px)
    return np.broadcast_to(profile if axis_of(entry) == "u" else profile[:, None], (height, width)).copy()


def axis_of(entry: Entry) -> str:
    """Return the projector axis "u" or "v" along which an entry varies ("u" for white and black)."""
    return entry.axis if isinstance(entry, (Phase, Gray, Statistical)) else "u"


def phase_steps(period_px: float, steps: int, axis: str = "u", wave: str = "sine") -> list[Entry]:
    """Return the entries of one fringe period in equal phase steps."""
    return [
        Phase.parse(
            {"role": "phase", "axis": axis, "period_px": period_px, "step": step, "steps": steps, "wave": wave},
            "phase step",
        )
        for step in range(steps)
    ]


def reference_sequence() -> list[Entry]:
    """Return the sequence of the reference sensor: 12 phase images (three periods, 4 steps each), white, black."""
    fringes = [entry for period in REFERENCE_PERIODS_PX for entry in phase_steps(period, REFERENCE_STEPS)]
    return [*fringes, White(role="white"), Black(role="black")]


def gray_sequence(projector_px: tuple[int, int] = (1280, 800), period_px: float = 20.0, steps: int = 4) -> list[Entry]:
    """Return phase steps of one period, the Gray code of the period's number and its complementary bit, white, black.

    The cells are half periods, so that the lowest bit is the complementary bit.
    """
    cells = int(np.ceil(projector_px[0] / (period_px / 2)))
    bits = reversed(range(max(1, (cells - 1).bit_length())))
    code: list[Entry] = [Gray(role="gray", bit=bit, cell_px=period_px / 2) for bit in bits]
    return [*phase_steps(period_px, steps), *code, White(role="white"), Black(role="black")]


#: Sequences by name.
SEQUENCES = {"reference": reference_sequence, "gray": gray_sequence}


def named_sequence(name: str) -> Sequence[Entry]:
    """Return a sequence by its name; an unknown name is an error that lists the known ones."""
    if name not in SEQUENCES:
        raise InputError("sequence", f"found '{name}'", f"one of {', '.join(SEQUENCES)}")
    return SEQUENCES[name]()


def _encode_phase(entry: Phase, u: Array) -> Array:
    # I_k = A + B cos(phi - 2 pi k / N); `sign` turns the direction of k.
    wave = np.cos(2 * np.pi * (u / entry.period_px - entry.sign * entry.step / entry.steps))
    if entry.wave == "sine":
        return 0.5 + 0.5 * wave
    return np.where(np.abs(wave) < EDGE, 0.5, (wave > 0).astype(float))


def _encode_gray(entry: Gray, u: Array) -> Array:
    cell = np.floor(np.floor(u + 0.5) / entry.cell_px).astype(np.int64)
    lit = ((cell ^ (cell >> 1)) >> entry.bit) & 1
    return (1 - lit if entry.inverse else lit).astype(float)
