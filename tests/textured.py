"""Sequences of fringes on a textured, still or moving picture, made without the simulator."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from planish.sensing.patterns.sequences import encode

#: Samples of the texture per pixel: linear interpolation keeps shifts exact (cubic does not).
FINE = 8
SIZE_PX = (512, 384)


@cache
def texture(contrast, seed=1, blur_px=0.7):
    """Relative brightness on a fine grid, as a lens of `blur_px` shows it."""
    width, height = SIZE_PX
    noise = np.random.default_rng(seed).standard_normal(((height + 16) * FINE, (width + 16) * FINE)).astype(np.float32)
    fine = cv2.GaussianBlur(noise, (0, 0), blur_px * FINE)
    return 1 + np.float32(contrast) * fine / fine.std()


def picture(fine, shift_px=(0.0, 0.0)):
    """The texture at the pixels, moved by (u, v) [px]."""
    width, height = SIZE_PX
    u = (np.arange(width, dtype=np.float32) + 8 - shift_px[0]) * FINE
    v = (np.arange(height, dtype=np.float32) + 8 - shift_px[1]) * FINE
    maps = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
    return cv2.remap(fine, *maps, cv2.INTER_LINEAR)


def sequence(entries, pictures, *, grey=150.0, ambient=6.0, gamma=1.0, gains=None, noise=(1.44, 0.025), seed=0):
    """Images of all entries (reference projector columns across the image), each on its own picture."""
    rng, images = np.random.default_rng(seed), []
    position = np.broadcast_to(np.linspace(100, 700, SIZE_PX[0]), SIZE_PX[::-1])
    for k, (entry, shown) in enumerate(zip(entries, pictures, strict=True)):
        light = grey * encode(entry, position) ** gamma * (1.0 if gains is None else gains[k]) + ambient
        level = light * shown
        level = level + rng.standard_normal(level.shape) * np.sqrt(noise[0] + noise[1] * level)
        images.append(np.clip(np.round(level), 0, 255).astype(np.uint8))
    return images
