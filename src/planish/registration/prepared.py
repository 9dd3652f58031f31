"""What pairs need of one measurement: surface, texture, keypoints, and the maps of the refinement."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from planish.measurement import Map, Measurement
from planish.options import side_by_side, thread_count
from planish.registration.dense.match import DenseOptions, DenseTexture, prepare_dense
from planish.registration.keypoints.detect import detect_keypoints
from planish.registration.keypoints.keypoints import Keypoints
from planish.registration.match.whitening import PatchImage, patch_images
from planish.registration.options import PairOptions
from planish.registration.refine.sides import JointSide, held_out_pixels, joint_sides
from planish.registration.surface import Surface, fit_surface
from planish.registration.texture.camera_pattern import FixedPattern
from planish.registration.texture.charts import plan_charts
from planish.registration.texture.photometric import local_contrast
from planish.registration.texture.resample import TextureImage, texture_images
from planish.registration.texture.strength import signal_to_noise

#: Per spacing of the pixels.
Sides = Mapping[int, JointSide]


class RefinementMaps:
    """What the refinement needs of one measurement: made when the first pair is accepted, for most are refused.

    `make` returns per spacing the maps, and those without the tiles that later judge the fit. Each measurement has a
    lock of its own: those of others are made at the same time.
    """

    def __init__(self, make: Callable[[], tuple[Sides, Sides]]) -> None:
        self._make, self._lock = make, threading.Lock()
        self._made: tuple[Sides, Sides] | None = None

    def get(self) -> tuple[Sides, Sides]:
        """Return what `make` has made, made once."""
        with self._lock:
            if self._made is None:
                self._made = self._make()
            return self._made

    def begin(self) -> None:
        """Make what `make` makes, unless another thread is at it: then there may be something else to do before."""
        if self._lock.acquire(blocking=False):
            try:
                if self._made is None:
                    self._made = self._make()
            finally:
                self._lock.release()


@dataclass(frozen=True)
class Prepared:
    """What registration needs of one measurement, computed once and used in every pair."""

    measurement: Measurement
    surface: Surface
    contrast: tuple[Map, Map]
    images: tuple[TextureImage, ...]
    patches: tuple[PatchImage, ...]
    keypoints: Keypoints
    refinement: RefinementMaps
    dense_options: DenseOptions

    @property
    def sides(self) -> Sides:
        """Per spacing of the pixels what the refinement needs."""
        return self.refinement.get()[0]

    @property
    def fit_sides(self) -> Sides:
        """The same without the tiles that later judge the fit."""
        return self.refinement.get()[1]

    @cached_property
    def dense(self) -> tuple[DenseTexture, ...]:
        """The developed texture: made when the first pair asks for it."""
        return prepare_dense(self.images, self.dense_options)

    @cached_property
    def signal_to_noise(self) -> float:
        """How strong the texture is against its noise (variances)."""
        return signal_to_noise(self.images)


@dataclass(frozen=True)
class Textured:
    """A measurement with its surface, its local contrast (value, sigma) and its texture images."""

    measurement: Measurement
    surface: Surface
    contrast: tuple[Map, Map]
    images: tuple[TextureImage, ...]


def draw_texture(
    measurement: Measurement,
    pitch_mm: float,
    options: PairOptions | None = None,
    threads: int | None = None,
    fixed: FixedPattern | None = None,
) -> Textured:
    """Return surface and texture images of one measurement: all that its keypoints need.

    `fixed` is the pattern of its sensor (`estimate_fixed_patterns`), which is no texture.
    """
    options = options or PairOptions()
    surface = fit_surface(measurement, options.surface, threads)
    return draw_on_surface(measurement, surface, pitch_mm, options, threads, fixed)


def draw_on_surface(
    measurement: Measurement,
    surface: Surface,
    pitch_mm: float,
    options: PairOptions,
    threads: int | None = None,
    fixed: FixedPattern | None = None,
) -> Textured:
    """Return what `draw_texture` does, of a surface that has been fitted; charts are planned beside the contrast."""
    contrast, charts = side_by_side(
        [
            lambda: local_contrast(measurement, options.photometric, surface, fixed, threads),
            lambda: plan_charts(measurement, surface, options.charts),
        ],
        thread_count(threads),
    )
    images = texture_images(measurement, surface, contrast, pitch_mm, charts, threads)
    return Textured(measurement, surface, contrast, images)


def prepare_textured(
    item: Textured, keypoints: Keypoints, options: PairOptions | None = None, threads: int | None = None
) -> Prepared:
    """Return what pairs need beyond texture images and keypoints: maps for patches and refinement."""
    options = options or PairOptions()
    measurement, surface, contrast = item.measurement, item.surface, item.contrast
    spacings, shading_mm = options.refine.spacing_px, options.photometric.shading_mm

    def make() -> tuple[Sides, Sides]:
        sides = joint_sides(measurement, surface, contrast, spacings, shading_mm, threads)
        return sides, leave_out(sides, held_out_pixels(measurement))

    patches, maps = patch_images(item.images), RefinementMaps(make)
    return Prepared(measurement, surface, contrast, item.images, patches, keypoints, maps, options.dense)


def prepare(
    measurement: Measurement,
    pitch_mm: float,
    options: PairOptions | None = None,
    threads: int | None = None,
    fixed: FixedPattern | None = None,
) -> Prepared:
    """Return surface, texture images, keypoints and refinement maps of one measurement.

    `fixed` is the pattern of its sensor (`estimate_fixed_patterns`), which is no texture.
    """
    options = options or PairOptions()
    textured = draw_texture(measurement, pitch_mm, options, threads, fixed)
    return prepare_textured(textured, detect_keypoints(textured.images, options.keypoints), options, threads)


def leave_out(sides: Sides, mask: NDArray[np.bool_] | None) -> Sides:
    """Return the maps without the pixels of a mask (H, W), all of them where there is none."""
    return sides if mask is None else {n: side.without(mask) for n, side in sides.items()}
