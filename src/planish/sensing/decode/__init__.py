"""From the images of the cameras to the absolute projector position of every pixel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from planish.measurement import Map
from planish.sensing.capture import GreyImage
from planish.sensing.decode.gray import gray_offset, gray_positions
from planish.sensing.decode.phase import DecodeOptions, PhaseMap, decode, position_slope
from planish.sensing.noise import estimate_noise, full_scale
from planish.sensing.sequence import Layout

__all__ = ["DecodeOptions", "PhaseMap", "decode", "decode_views", "position_slope"]


def decode_views(
    images: Mapping[str, Sequence[GreyImage]], layout: Layout, options: DecodeOptions, subject: str, threads: int
) -> dict[str, PhaseMap]:
    """Return the PhaseMap of each camera, with its noise estimated and its Gray code tied to the fringes.

    Parameters
    ----------
    images : mapping of camera name to images (H, W)
        In the order of the sequence.
    layout : Layout
        What they show.
    options : DecodeOptions
        Limits.
    subject : str
        Named in errors.
    threads : int
        Number of threads; the result does not depend on it.
    """
    coarse: dict[str, Map | None] = dict.fromkeys(images)
    if layout.gray is not None:
        gray = {name: gray_positions(stack, layout, threads) for name, stack in images.items()}
        offset = np.float32(gray_offset([(images[name], gray[name]) for name in images], layout, subject))
        coarse = {name: position - offset for name, position in gray.items()}
    phases = {}
    for name, stack in images.items():
        saturation = full_scale(stack)
        noise = estimate_noise(stack, layout, saturation)
        phases[name] = decode(stack, layout, noise, saturation, options, threads, coarse[name])
    return phases
