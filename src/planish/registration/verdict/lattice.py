"""Textures that repeat in themselves: how often the pattern stands on a part, and motions that are a period apart.

Of a pattern finer than the windows a motion may be taken for significant by how the pattern happens to meet itself, and
neither the consensus nor the correlation of whole pictures leads to the others that fit as well. The period does.
"""

from __future__ import annotations

import cv2
import numpy as np

from planish.geometry import Array
from planish.registration.texture.periods import Period
from planish.registration.texture.resample import TextureImage
from planish.registration.verdict.aligned import Side, align
from planish.registration.verdict.hypothesis import Hypothesis, as_hypothesis
from planish.registration.verdict.repeats import as_rigid_motion
from planish.registration.verdict.window_sizes import VerifyOptions

#: Contrast of so many standard deviations of its noise is no noise.
_SURELY = 5.0


def common_period(images_a: tuple[TextureImage, ...], images_b: tuple[TextureImage, ...]) -> Period | None:
    """Return the period of both textures, of a's image; None where one of them does not repeat, or differently."""
    if not images_a or not images_b:
        return None
    a = _largest(images_a).period
    b = None if a is None else _largest(images_b).period
    if a is None or b is None or abs(a.period_mm - b.period_mm) > max(a.pitch_mm, b.pitch_mm):
        return None
    return a


def positions(period: Period, images: tuple[TextureImage, ...]) -> int:
    """Return how often a pattern stands in the images of a measurement, a blank surface around it not counted."""
    area, cell = sum(_patterned_mm2(image, period) for image in images), period.cell_mm2
    return round(np.sqrt(area) / period.period_mm if cell is None else area / cell)


def _patterned_mm2(image: TextureImage, period: Period) -> float:
    edge = max(1, round(period.period_mm / image.pitch_mm))
    strong = (np.abs(image.value) > _SURELY * image.sigma) & image.mask
    return (
        float(np.count_nonzero(cv2.dilate(strong.astype(np.uint8), np.ones((edge, edge), np.uint8))))
        * image.pitch_mm**2
    )


def as_good_a_period_off(
    a: Side, b: Side, first: Hypothesis, options: VerifyOptions, share: float
) -> Hypothesis | None:
    """Return a motion that a period of both textures leads to and that windows speak for, too, if there is one.

    Motions of this kind are not found but computed: no chance chose them, so that it is enough if as many windows agree
    as `share` of those that agree with the first.
    """
    period = common_period(a.images, b.images)
    if period is None:
        return None
    for T in _shifted(a, b, first.T_a_b, period, options.gate_mm):
        other = as_hypothesis(a, b, T, options)
        if other.agreeing >= share * first.agreeing:
            return other
    return None


def _shifted(a: Side, b: Side, T_a_b: Array, period: Period, gate_mm: float) -> list[Array]:
    """Transforms (4, 4) that T_a_b becomes where b is moved by a period on a's surface, either way."""
    image = _largest(a.images)
    chart = next((c for c in align(a, b, T_a_b, gate_mm) if c.image is image), None)
    if chart is None:
        return []
    shifts = [sign * shift for shift in period.shifts_px for sign in (1, -1)]
    motions = (as_rigid_motion(chart, np.column_stack([np.eye(2), shift]), gate_mm) for shift in shifts)
    return [motion @ T_a_b for motion in motions if motion is not None]


def _largest(images: tuple[TextureImage, ...]) -> TextureImage:
    return max(images, key=lambda image: int(image.mask.sum()))
