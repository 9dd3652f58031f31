"""Search: one texture laid on the other in every shift, for a set of rotations."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from planish.geometry import Array
from planish.measurement import Map

#: Overlap smaller than this share of the smaller texture is not looked at.
LEAST_OVERLAP = 0.08
#: Masks are correlated at this reduction: an overlap changes slowly with the shift.
_REDUCTION = 8
#: Peaks kept per rotation, and the distance within which one hides another [px].
_PEAKS, _APART_PX = 2, 8


@dataclass(frozen=True)
class Placement:
    """b's development laid on a's: x_a = R(angle_rad) x_b + shift_px, with its significance.

    Parameters
    ----------
    angle_rad : float
    shift_px : ndarray (2,)
    sigma : float
        Correlation in standard deviations of all the other shifts.
    overlap_px : float
        Area in common.
    """

    angle_rad: float = field(metadata={"unit": "rad"})
    shift_px: Array = field(metadata={"unit": "px"})
    sigma: float
    overlap_px: float = field(metadata={"unit": "px"})

    def map(self) -> Array:
        """Return the affine map (2, 3) from b to a [px]."""
        return np.column_stack([_turn(self.angle_rad), self.shift_px])


@dataclass(frozen=True)
class Found:
    """The best placements of a search, best first, and how many independent placements were looked at."""

    placements: tuple[Placement, ...]
    looked_at: float


def search(
    a: Map, mask_a: NDArray[np.bool_], b: Map, mask_b: NDArray[np.bool_], angles: Array, threads: int = 1
) -> Found:
    """Return the most significant placements of b (h, w) in a (H, W) over all shifts and `angles` (n,) [rad]."""
    turned = [_turned_extent(b.shape, angle) for angle in angles]
    extent = np.max([size for _, size in turned], axis=0) if turned else np.zeros(2)
    # Whole blocks of the reduced masks.
    h, w = (
        _REDUCTION * fft.next_fast_len(int(np.ceil((n + m) / _REDUCTION)), True)
        for n, m in zip(a.shape, extent[::-1], strict=True)
    )
    reduced = (h // _REDUCTION, w // _REDUCTION)
    spectrum_a = fft.rfft2(a, (h, w), workers=threads)
    cover_a = fft.rfft2(_reduced(mask_a.astype(np.float32), (h, w)), workers=threads)
    least = LEAST_OVERLAP * min(int(mask_a.sum()), int(mask_b.sum()))
    found: list[Placement] = []
    looked_at = 0.0
    for angle, (low, size) in zip(angles, turned, strict=True):
        affine = np.column_stack([_turn(angle), -low])
        image = cv2.warpAffine(b, affine, tuple(size.tolist()), flags=cv2.INTER_CUBIC)
        cover = cv2.warpAffine(mask_b.astype(np.float32), affine, tuple(size.tolist()), flags=cv2.INTER_LINEAR)
        surface = fft.irfft2(
            spectrum_a * np.conj(fft.rfft2(image, (h, w), workers=threads)), (h, w), workers=threads
        )  # fmt: skip
        overlap = fft.irfft2(cover_a * np.conj(fft.rfft2(_reduced(cover, (h, w)), workers=threads)), reduced)
        overlap = cv2.resize(overlap.astype(np.float32) * _REDUCTION**2, (w, h), interpolation=cv2.INTER_LINEAR)
        surface = np.where(overlap >= least, surface / np.sqrt(np.maximum(overlap, 1)), np.float32(0))
        found += _peaks(surface, overlap, float(angle), low)
        looked_at += float((overlap >= least).sum())
    found.sort(key=lambda p: (-p.sigma, p.angle_rad))
    return Found(_distinct(found, a.shape), looked_at)


def _peaks(surface: Map, overlap: Map, angle: float, low: Array) -> list[Placement]:
    h, w = surface.shape
    sample = surface[::5, ::5]
    sample = sample[sample != 0]
    spread = 1.4826 * float(np.median(np.abs(sample))) if len(sample) else 0.0
    if spread <= 0:
        return []
    surface, peaks = surface.copy(), []
    around = np.arange(-_APART_PX, _APART_PX + 1)
    for _ in range(_PEAKS):
        row, column = divmod(int(surface.argmax()), w)
        shift = np.array([column - w if column > w // 2 else column, row - h if row > h // 2 else row], float)
        # Shifts run round: the far half of the surface holds the negative ones.
        peaks.append(Placement(angle, shift - low, float(surface[row, column] / spread), float(overlap[row, column])))
        surface[np.ix_((row + around) % h, (column + around) % w)] = 0
    return peaks


def _distinct(found: list[Placement], shape: tuple[int, int], most: int = 6) -> tuple[Placement, ...]:
    """The best of all rotations without those that lay b's middle at the same place, turned nearly alike."""
    kept: list[Placement] = []
    for one in found:
        same = [
            k
            for k in kept
            if abs(np.angle(np.exp(1j * (k.angle_rad - one.angle_rad)))) < _ALIKE
            and np.linalg.norm(k.map() @ [0, 0, 1] - one.map() @ [0, 0, 1]) < _ALIKE * np.hypot(*shape) + 2 * _APART_PX
        ]
        if not same:
            kept.append(one)
        if len(kept) == most:
            break
    return tuple(kept)


#: Placements turned by less than this against each other are one [rad].
_ALIKE = 0.06


def _turn(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _turned_extent(shape: tuple[int, int], angle: float) -> tuple[Array, NDArray[np.intp]]:
    """Least corner (2,) and size (2,) [px] of a turned image."""
    h, w = shape
    corners = np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]]) @ _turn(angle).T
    low = np.floor(corners.min(0))
    return low, (np.ceil(corners.max(0)) - low).astype(np.intp) + 1


def _reduced(mask: Map, size: tuple[int, int]) -> Map:
    full = np.zeros(size, np.float32)
    full[: mask.shape[0], : mask.shape[1]] = mask
    return cv2.resize(full, (size[1] // _REDUCTION, size[0] // _REDUCTION), interpolation=cv2.INTER_AREA)
