"""The exponent of the response between projected pattern and grey value, from the fringes between black and white."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from planish.measurement import Finding, NoiseModel
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import Layout

#: Every so many rows and columns are looked at.
SAMPLE_STRIDE = 8
#: White must exceed black by so many standard deviations of a grey value; so many pixels must do so.
MIN_CONTRAST_SIGMAS, MIN_PIXELS = 30.0, 200
#: Pixels that are enough for a hundredth.
ENOUGH_PIXELS = 4000
#: Exponents that are looked for.
RANGE = (0.2, 5.0)


def gamma_finding(
    images: Sequence[GreyImage], layout: Layout, noise: NoiseModel, saturation: float, camera: str
) -> Finding | None:
    """Return gamma with grey value - black = (white - black) pattern^gamma; None for sequences without fringes.

    Parameters
    ----------
    images : sequence of ndarray (H, W)
        All images of the camera.
    layout : Layout
        What they show.
    noise : NoiseModel
        Of a grey value.
    saturation : float
        Pixels whose white reaches this grey level are left out.
    camera : str
        Its name.

    Notes
    -----
    The steps of a period add up to N / 2 patterns wherever a pixel lies in it: mean over k and the pixels of
    ((I_k - black) / (white - black))^(1 / gamma) = 1/2. The longest period is the least blurred.
    """
    if not layout.periods:
        return None
    quantity = f"gamma of projector and camera {camera} together"
    if not layout.white or not layout.black:
        return Finding(quantity, None, None, "", "no white and black image")

    def mean(indices: Sequence[int]) -> NDArray[np.float64]:
        stack = [images[i][::SAMPLE_STRIDE, ::SAMPLE_STRIDE] for i in indices]
        return np.asarray(np.mean(stack, axis=0, dtype=float))

    white, black = mean(layout.white), mean(layout.black)
    contrast = white - black
    usable = (white < saturation) & (contrast > MIN_CONTRAST_SIGMAS * np.sqrt(noise.variance(white.astype(np.float32))))
    if usable.sum() < MIN_PIXELS:
        return Finding(quantity, None, None, "", "too few pixels between black and saturation")
    usable[np.unravel_index(_surplus(usable), usable.shape)] = False
    steps = max(layout.periods, key=lambda period: period.period_px).images
    relative = np.clip(np.stack([(mean((i,)) - black)[usable] / contrast[usable] for i in steps]), 0.0, None)

    def excess(exponent: float) -> float:
        return float(np.median((relative**exponent).mean(0)) - 0.5)

    low, high = 1 / RANGE[1], 1 / RANGE[0]
    if excess(low) * excess(high) >= 0:
        return Finding(quantity, None, None, "", f"outside {RANGE[0]:g} ... {RANGE[1]:g}")
    exponent = float(brentq(excess, low, high, xtol=1e-6))
    shares = (relative**exponent).mean(0)
    slope = (excess(exponent * 1.01) - excess(exponent / 1.01)) / (exponent * 0.0199)
    spread = 1.4826 * float(np.median(np.abs(shares - np.median(shares)))) * np.sqrt(np.pi / 2 / shares.size)
    sigma = spread / abs(slope) / exponent**2
    return Finding(quantity, 1 / exponent, float(sigma), "", "fringes between black and white")


def _surplus(usable: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return which usable pixels are more than enough, evenly spread."""
    places = np.flatnonzero(usable)
    return np.delete(places, np.s_[:: max(1, len(places) // ENOUGH_PIXELS)])
