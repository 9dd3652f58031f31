"""Both textures in one picture: b's texture drawn where a transform puts it in a's texture images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array, invert
from planish.measurement import Map, Measurement
from planish.options import thread_count
from planish.registration.texture.resample import TextureImage


@dataclass(frozen=True)
class Side:
    """What the verdict needs of one measurement.

    Parameters
    ----------
    measurement : Measurement
    images : tuple of TextureImage
    contrast : tuple of two ndarray (H, W) float32
        Its local contrast with standard deviation.
    threads : int or None
        How many draw it on another one's images, and transform that.
    """

    measurement: Measurement
    images: tuple[TextureImage, ...]
    contrast: tuple[Map, Map]
    threads: int | None = None

    @property
    def maps(self) -> tuple[Map, Map, Map]:
        """Points (H, W, 3), contrast and its standard deviation, as the kernels take them."""
        value, sigma = (np.ascontiguousarray(x, np.float32) for x in self.contrast)
        return np.ascontiguousarray(self.measurement.points_sensor, np.float32), value, sigma


@dataclass(frozen=True)
class Aligned:
    """A texture image of a and what a transform puts there of b; all maps are (h, w) on the image's pixels.

    Parameters
    ----------
    image : TextureImage
        Of a.
    common : ndarray (h, w) bool
        Where b has its surface within the gate of a's: the common region that the transform predicts. What several
        images of a hold counts in the first of them.
    value_b, sigma_b : ndarray (h, w) float32
        Texture of b and its standard deviation there, 0 elsewhere.
    source_b : ndarray (h, w, 2) float32
        Pixel (u, v) of b's organising camera; NaN where not `common`.
    """

    image: TextureImage
    common: NDArray[np.bool_]
    value_b: Map
    sigma_b: Map
    source_b: Map


def align(
    a: Side, b: Side, T_a_b: Array, gate_mm: float, lattice_px: tuple[int, int] | None = None
) -> tuple[Aligned, ...]:
    """Return, per texture image of a, b's texture under T_a_b; surfaces belong together within `gate_mm`.

    `lattice_px` is distance and edge of squares [texture px] outside which nothing is asked.
    """
    covered = np.zeros(a.measurement.shape, bool) if len(a.images) > 1 else None
    return tuple(_align_one(_asked(image, covered, lattice_px), image, b, T_a_b, gate_mm) for image in a.images)


def _asked(
    image: TextureImage, covered: NDArray[np.bool_] | None, lattice_px: tuple[int, int] | None
) -> NDArray[np.bool_]:
    own = image.mask if covered is None else _not_yet(image, covered)
    if lattice_px is None:
        return own
    rows, columns = (np.arange(n) % lattice_px[0] < lattice_px[1] for n in own.shape)
    return own & rows[:, None] & columns[None, :]


def _align_one(own: NDArray[np.bool_], image: TextureImage, b: Side, T_a_b: Array, gate_mm: float) -> Aligned:
    source, value, sigma, common = _core.align_texture(
        image.source_px, own.view(np.uint8), image.surface.points_sensor, image.surface.normals_sensor,
        b.measurement.camera.kernel_parameters, *b.maps, invert(T_a_b), gate_mm, thread_count(b.threads),
    )  # fmt: skip
    return Aligned(image, common.view(np.bool_), value, sigma, source)


def _not_yet(image: TextureImage, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (h, w) of an image of a that no earlier one holds; marks in `covered` (H, W) what it holds."""
    v, u = np.nonzero(image.mask)
    column, row = np.clip(np.rint(image.source_px[v, u]).astype(int), 0, np.array(covered.shape)[::-1] - 1).T
    new = ~covered[row, column]
    own = np.zeros(image.mask.shape, bool)
    own[v[new], u[new]] = True
    held = np.zeros(covered.shape, np.uint8)
    held[row, column] = 1
    # A texture pixel is coarser than a camera pixel: what lies between its samples is held as well.
    covered |= cv2.dilate(held, np.ones((3, 3), np.uint8)) > 0
    return own
