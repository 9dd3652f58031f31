"""How large the windows of the verification are, how many there are, and how far they are sought."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from planish.options import Options
from planish.registration.texture.resample import TextureImage


class VerifyOptions(Options):
    """Options of the verification."""

    #: Edge of a window [mm].
    window_mm: float = Field(default=10.0, gt=0)
    #: A window is looked for this far around where it should be [mm].
    search_mm: float = Field(default=4.0, gt=0)
    #: It agrees if its peak lies this near to where it should be [mm]; less would ask more of a coarse transform than
    #: it holds at the rim of the common region.
    agree_mm: float = Field(default=1.0, gt=0)
    #: Surfaces farther apart than this under a coarse transform do not belong together [mm].
    gate_mm: float = Field(default=3.0, gt=0)


def size_px(images: tuple[TextureImage, ...], options: VerifyOptions) -> tuple[int, int]:
    """Edge of a window and reach of the search [texture px]."""
    if not images:
        return 1, 1
    pitch = images[0].pitch_mm
    return max(4, round(options.window_mm / pitch)), max(2, round(options.search_mm / pitch))


def for_areas(
    images_a: tuple[TextureImage, ...], images_b: tuple[TextureImage, ...], options: VerifyOptions
) -> VerifyOptions:
    """Return the options with windows small enough that a small measurement's overlap still holds a number of them.

    The size depends on the areas alone, so that all transforms of a pair are held against the same windows.
    """
    edge_mm = float(np.sqrt(_OVERLAP * min(area_mm2(images_a), area_mm2(images_b)) / _FEW))
    if not 0 < edge_mm < options.window_mm:
        return options
    return options.model_copy(update={"window_mm": max(edge_mm, _LEAST_SHARE * options.window_mm)})


#: An overlap of this share of the smaller area shall hold so many windows, as far as they can be made smaller: half
#: the edge leaves a window a hundred pixels of the texture images, some 60 of them independent.
_OVERLAP, _FEW, _LEAST_SHARE = 0.3, 25, 0.5


def too_small(images: tuple[TextureImage, ...], options: VerifyOptions) -> bool:
    """Whether an overlap with these texture images holds too few windows, however small they have been made."""
    return round(_OVERLAP * area_mm2(images) / options.window_mm**2) < _FEW


def area_mm2(images: tuple[TextureImage, ...]) -> float:
    """Return the area of all texture images [mm^2]."""
    return float(sum(int(i.mask.sum()) * i.pitch_mm**2 for i in images))


def screening_step(images: tuple[TextureImage, ...], options: VerifyOptions) -> int:
    """Return `every` of `correlate_windows` that leaves some hundreds of windows: enough to see whether any agree."""
    total = sum(int(image.mask.sum()) for image in images) / size_px(images, options)[0] ** 2
    return max(1, round(float(np.sqrt(total / _SCREENED))))


#: Windows on a when a transform is screened.
_SCREENED = 200
