"""Gray code: which cell of the projector a pixel sees, and how the cells lie relative to the fringes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.errors import InputError
from planish.measurement import Map
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import AxisCode, Layout
from planish.sensing.capture.unwrapping import Level
from planish.sensing.decode.average import mean_image

Wave = NDArray[np.complex128]

#: Every so many rows and columns serve to estimate the offset of the cells.
SAMPLE_STRIDE = 10
#: Smallest agreement (length of the mean unit vector, 0 ... 1) at which cells and fringes belong together. Cells of
#: half a period give 0.90, cells of a whole one 0, for their residuals fill the circle.
MIN_AGREEMENT = 0.3
#: Pixels with a smaller amplitude than this share of the largest do not take part in the estimate.
MIN_MODULATION = 0.2


class Contradiction(InputError):
    """Coarse and fine patterns contradict each other nearly everywhere."""


def gray_positions(images: Sequence[GreyImage], code: AxisCode, layout: Layout, threads: int) -> Map:
    """Return the projector position (H, W) [px] of the centre of each pixel's Gray cell.

    Cell k reaches from pixel coordinate k c - 0.5 to (k + 1) c - 0.5, c being its length.

    Notes
    -----
    A bit is lit where its image is brighter than its inverse; without inverse images, than the mean of white and black;
    without these, than the mean of the fringe images.
    """
    gray = code.gray
    assert gray is not None
    wanted = (*gray.images, *(i for i in gray.inverse if i >= 0))
    selected = [images[i] for i in wanted]
    position = {index: k for k, index in enumerate(wanted)}
    inverse = [position[i] if i >= 0 else -1 for i in gray.inverse]
    threshold = np.empty((0, 0), np.float32) if min(inverse) >= 0 else _threshold(images, code, layout)
    cell = _core.decode_gray(selected, inverse, threshold, threads)
    return (cell + np.float32(0.5)) * np.float32(gray.cell_px) - np.float32(0.5)


def _threshold(images: Sequence[GreyImage], code: AxisCode, layout: Layout) -> Map:
    if layout.white and layout.black:
        return np.asarray(0.5 * (mean_image(images, layout.white) + mean_image(images, layout.black)), np.float32)
    return mean_image(images, code.phase_images)


def gray_offset(views: Sequence[tuple[Sequence[GreyImage], Map]], code: AxisCode, subject: str) -> float:
    """Return the constant by which Gray positions exceed phase positions, in (-P/2, P/2] [px].

    Sequences in use differ in where the phase is zero relative to the cells: some start a fringe at the border of a
    cell, some at its centre. Only whole periods are taken from the Gray code, so the constant need not be exact; but it
    must be the same in all cameras, or they would differ by a period.

    Parameters
    ----------
    views : sequence of (images, Gray positions (H, W))
        Of all cameras.
    code : AxisCode
        What the images show.
    subject : str
        Named in errors.

    Notes
    -----
    Circular mean of (Gray - phase) / P over all pixels with good modulation (Mardia & Jupp, Directional Statistics).
    """
    assert code.gray is not None
    assert code.ladder is not None
    level = code.ladder.levels[0]
    if code.gray.cell_px > 0.75 * level.period_px:
        return 0.0
    total, count = 0j, 0
    for images, position in views:
        wave, amplitude = _level_wave(images, code, level)
        usable = amplitude > MIN_MODULATION * np.quantile(amplitude, 0.99)
        gray = np.exp(2j * np.pi * position[::SAMPLE_STRIDE, ::SAMPLE_STRIDE][usable] / level.period_px)
        total += (gray * wave[usable].conj()).sum()
        count += int(usable.sum())
    if count == 0 or abs(total) < MIN_AGREEMENT * count:
        raise Contradiction(
            f"{subject}: sequence",
            "Gray code and phase contradict each other nearly everywhere",
            "Gray bits in the right order (bit 0 the finest), the right cell_px, period_px and sign",
        )
    return float(np.angle(total) * level.period_px / (2 * np.pi))


def _level_wave(images: Sequence[GreyImage], code: AxisCode, level: Level) -> tuple[Wave, NDArray[np.float64]]:
    """Return exp(i phase) of a level, and the smallest amplitude of its fringes, at the sampled pixels."""
    product: Wave | None = None
    least: NDArray[np.float64] | None = None
    for coefficient, steps in zip(level.coefficients, code.periods, strict=True):
        if coefficient == 0:
            continue
        stack = np.stack([images[i][::SAMPLE_STRIDE, ::SAMPLE_STRIDE] for i in steps.images]).astype(float)
        wave: Wave = np.tensordot(np.exp(1j * steps.angles), stack, 1)
        amplitude = np.abs(wave)
        unit = (wave / np.maximum(amplitude, 1e-12)) ** coefficient
        product = unit if product is None else product * unit
        least = amplitude if least is None else np.minimum(least, amplitude)
    assert product is not None
    assert least is not None
    return product, least
