"""How strong the texture of a measurement is against its noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from planish.registration.texture.resample import TextureImage


def texture_strength(images: Sequence[TextureImage]) -> tuple[float, float]:
    """Return the standard deviation of what is seen of the texture and that of its noise, as local contrast.

    Robust: what holds for most of the surface. Sparse specks and scratches are no texture that every overlap would
    hold.
    """
    values = [image.value[image.mask][::7] for image in images if image.mask.any()]
    sigmas = [image.sigma[image.mask][::7] for image in images if image.mask.any()]
    if not values:
        return 0.0, 0.0
    return 1.4826 * float(np.median(np.abs(np.concatenate(values)))), float(np.median(np.concatenate(sigmas)))


def signal_to_noise(images: Sequence[TextureImage]) -> float:
    """Return the variance of the texture without its noise over that of the noise."""
    seen, noise = texture_strength(images)
    return max((seen / max(noise, 1e-12)) ** 2 - 1, 0.0)
