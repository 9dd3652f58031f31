"""Does a texture repeat in itself? Then its keypoints all look alike, and no consensus can stand out.

A pattern that is finer than the windows and repeats (a chessboard, a raster of dots, a weave) leads every match to
another of its places. That no motion is found then says nothing about the overlap; what can be said is the period.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from planish.geometry import Array
from planish.measurement import Map
from planish.registration.texture.sampling import sample

#: Edge of the piece of a texture image that is asked [texture px]: periods up to half of it are found.
_PIECE_PX = 256
#: What moved by a period has this share of its variance in common with itself, of all that is not noise: so much are
#: two places of one pattern alike that differ in sharpness and light.
_SAME = 0.9
#: Between two places of a pattern the likeness falls below this share of what it is there; along a streak it does not.
_DIP = 0.5
#: Less signal in the variance: its share depends on how well the noise is known.
_LEAST_SIGNAL = 0.5
#: Share of the piece that has to be left over where it is moved.
_OVERLAP = 0.25
#: Peaks are drawn so many times finer, this far around [px].
_FINER, _AROUND_PX = 8, 3
#: Most peaks that are looked at, the nearest first.
_MOST_PEAKS = 200
#: Two shifts with a smaller sine between them run the same way.
_ASIDE = 0.3
#: No texture.
_NOTHING = np.zeros((1, 1), np.float32)


@dataclass(frozen=True)
class Period:
    """How a texture image repeats.

    Parameters
    ----------
    shifts_px : ndarray (n, 2)
        The shortest shift (x, y) that leads it onto itself and, where it repeats along a second direction, the
        shortest of that [texture px].
    pitch_mm : float
        Of the image.
    """

    shifts_px: Array = field(metadata={"unit": "px"})
    pitch_mm: float

    @property
    def period_mm(self) -> float:
        """Length of the shortest shift."""
        return float(np.hypot(*self.shifts_px[0])) * self.pitch_mm

    @property
    def cell_mm2(self) -> float | None:
        """Area within which the texture does not repeat; None where it repeats along one direction only."""
        if len(self.shifts_px) < 2:
            return None
        (x, y), (other_x, other_y) = self.shifts_px
        return float(abs(x * other_y - y * other_x)) * self.pitch_mm**2


def find_period(value: Map, sigma: Map, mask: NDArray[np.bool_], pitch_mm: float) -> Period | None:
    """Return how a texture (h, w) with its standard deviation repeats where it is known, or None."""
    piece, known, noise = _piece(value, sigma, mask)
    power = float((piece**2).sum()) / max(int(known.sum()), 1)
    signal = 1 - noise / max(power, 1e-30)
    if signal < _LEAST_SIGNAL:
        return None
    likeness = _likeness(piece, known)
    found: list[Array] = []
    for shift in _peaks(likeness, _SAME * signal):
        if _dips(likeness, shift) and (not found or _goes_elsewhere(likeness, found[0], shift)):
            found.append(shift)
            if len(found) == 2:
                break
    return Period(np.array(found), pitch_mm) if found else None


def _piece(value: Map, sigma: Map, mask: NDArray[np.bool_]) -> tuple[Map, Map, float]:
    """The texture in the middle of an image, 0 where unknown; where it is known (1, 0); the variance of its noise."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return _NOTHING, _NOTHING, 0.0
    top, left = (max(0, int(np.median(n)) - _PIECE_PX // 2) for n in (rows, columns))
    cut = np.s_[top : top + _PIECE_PX, left : left + _PIECE_PX]
    mask, value, sigma = mask[cut], value[cut], sigma[cut]
    if not mask.any():
        return _NOTHING, _NOTHING, 0.0
    noise = float((sigma[mask].astype(float) ** 2).mean())
    return np.where(mask, value - value[mask].mean(), np.float32(0)), mask.astype(np.float32), noise


def _likeness(value: Map, known: Map) -> Map:
    """Correlation coefficient of a picture with itself at all shifts up to half of it, no shift in the middle.

    Of pixels that are known at both places (masked normalised correlation: Padfield 2012); NaN where these are few.
    """
    size = fft.next_fast_len(int(1.5 * max(value.shape)))
    F, M, E = (fft.rfft2(x, s=(size, size)) for x in (value, known, value**2))
    reach = max(value.shape) // 2

    def at_shifts(spectrum: NDArray[np.complexfloating]) -> Map:
        whole = fft.irfft2(spectrum, s=(size, size))
        index = np.arange(-reach, reach + 1)
        return np.asarray(whole[index[:, None], index[None, :]])

    number = at_shifts(np.abs(M) ** 2)
    energies = np.maximum(at_shifts(E * np.conj(M)), 0) * np.maximum(at_shifts(M * np.conj(E)), 0)
    few = number < _OVERLAP * float(known.sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = at_shifts(np.abs(F) ** 2) / np.sqrt(energies)
    return np.where(few | ~np.isfinite(likeness), np.float32(-1), likeness).astype(np.float32)


def _peaks(likeness: Map, least: float) -> list[Array]:
    """Shifts (x, y) [px] at which the likeness has a peak of `least` and above, the nearest first; one of each two
    opposite ones.
    """
    reach = len(likeness) // 2
    peak = likeness >= cv2.dilate(likeness, np.ones((3, 3), np.uint8))
    # A peak between the pixels of the picture is higher than these: twice as low is looked at.
    row, column = np.nonzero(peak & (likeness > least / 2))
    x, y = column - reach, row - reach
    ahead = ((y > 0) | ((y == 0) & (x > 0))) & (np.maximum(np.abs(x), np.abs(y)) <= reach - _AROUND_PX)
    x, y = x[ahead], y[ahead]
    found = []
    for k in np.argsort(np.hypot(x, y), kind="stable")[:_MOST_PEAKS]:
        at, height = _between_pixels(likeness, int(y[k]) + reach, int(x[k]) + reach)
        if height >= least:
            found.append(at - reach)
    return found


def _between_pixels(likeness: Map, row: int, column: int) -> tuple[Array, float]:
    """Place (x, y) and height of a peak, drawn finer by cubic interpolation."""
    r = _AROUND_PX
    steps = np.arange(-_FINER, _FINER + 1, dtype=np.float32) / _FINER
    x, y = np.meshgrid(steps + r, steps + r)
    around = np.ascontiguousarray(likeness[row - r : row + r + 1, column - r : column + r + 1])
    fine = cv2.remap(around, x, y, cv2.INTER_CUBIC)
    i, j = np.unravel_index(int(np.argmax(fine)), fine.shape)
    return np.array([column + steps[j], row + steps[i]], float), float(fine[i, j])


def _dips(likeness: Map, shift: Array) -> bool:
    """Whether the likeness falls on the way to a shift: it is a place of its own, not the same streak."""
    way = np.linspace(0, 1, max(4, 2 * int(np.hypot(*shift))))[:, None] * shift + len(likeness) // 2
    along = sample(likeness, way)
    return bool(along.min() < _DIP * along[-1])


def _goes_elsewhere(likeness: Map, first: Array, shift: Array) -> bool:
    """Whether a shift leads along a direction of its own: not onto the stripes that multiples of the first lead to."""
    if _sine(first, shift) < _ASIDE:
        return False
    most = int(np.ceil(np.hypot(*shift) / np.hypot(*first)))
    return all(_dips(likeness, shift - k * first) for k in range(-most, most + 1))


def _sine(first: Array, other: Array) -> float:
    """Sine between two shifts, without its sign."""
    cross = first[0] * other[1] - first[1] * other[0]
    return float(abs(cross) / (np.hypot(*first) * np.hypot(*other)))
