"""Brightness of each entry of a sequence over the projector's own coordinates.

Phase: I = 1/2 + 1/2 cos(phi - sign 2 pi step / steps), phi = 2 pi u / period_px, u = 0 at the first pixel's centre.
Gray: reflected code g = k ^ (k >> 1) of cell k; cell k starts at projector pixel k cell_px.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planish.geometry import Array
from planish.sensing.patterns.entries import Black, Entry, Gray, Phase, Statistical, White
from planish.sensing.patterns.statistical import statistical_profile

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
        return np.asarray(statistical_profile(u, entry.index, entry.seed, entry.min_period_px), float)
    return _encode_gray(entry, u)


def projector_profile(entry: Entry, projector_px: tuple[int, int]) -> Array:
    """Return the brightness (n,) of every projector column (axis u) or row (axis v) of a (width, height) projector."""
    return encode(entry, np.arange(projector_px[0] if axis_of(entry) == "u" else projector_px[1]))


def projector_image(entry: Entry, projector_px: tuple[int, int]) -> Array:
    """Return the whole projected image (H, W), 0 to 1."""
    width, height = projector_px
    profile = projector_profile(entry, projector_px)
    return np.broadcast_to(profile if axis_of(entry) == "u" else profile[:, None], (height, width)).copy()


def pattern_image(entry: Entry, projector_px: tuple[int, int], gamma: float = 1.0) -> NDArray[np.uint8]:
    """Return the image (H, W) to project: a projector that shows brightness (value / 255)^gamma shows the entry."""
    return np.rint(255 * projector_image(entry, projector_px) ** (1 / gamma)).astype(np.uint8)


def entry_label(entry: Entry) -> str:
    """Return a short name of an entry for file names."""
    if isinstance(entry, Phase):
        text = f"phase_{entry.axis}_{entry.period_px:g}_{entry.step}"
    elif isinstance(entry, Gray):
        text = f"gray_{entry.axis}_{entry.bit}{'_inverse' if entry.inverse else ''}"
    elif isinstance(entry, Statistical):
        text = f"statistical_{entry.axis}_{entry.index}"
    else:
        text = entry.role
    return text if entry.exposure_ms is None else f"{text}_{entry.exposure_ms:g}ms"


def axis_of(entry: Entry) -> str:
    """Return the projector axis "u" or "v" along which an entry varies ("u" for white and black)."""
    return entry.axis if isinstance(entry, (Phase, Gray, Statistical)) else "u"


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
