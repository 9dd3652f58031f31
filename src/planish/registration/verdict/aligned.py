"""Both textures in one picture: b's texture drawn where a transform puts it in a's charts."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array, compose, invert, transform_points
from planish.measurement import Map
from planish.registration.texture.resample import TextureImage

#: Charts of one part overlap; each place is looked at in the chart that it faces, within this angle [cosine of 32 deg].
_FACING = 0.848


@dataclass(frozen=True)
class Aligned:
    """A chart of a and what a transform puts there of b; all maps are (h, w) on a's chart.

    Parameters
    ----------
    image : TextureImage
        The chart of a.
    own : ndarray (h, w) bool
        Where this chart of a counts.
    common : ndarray (h, w) bool
        Where b has its surface within the gate of a's: the common region that the transform predicts.
    value_b, sigma_b : ndarray (h, w) float32
        Texture of b and its standard deviation there, 0 elsewhere.
    source_b : ndarray (h, w, 2) float32
        Pixel (u, v) of b's organising camera; NaN where not `common`.
    """

    image: TextureImage
    own: NDArray[np.bool_]
    common: NDArray[np.bool_]
    value_b: Map
    sigma_b: Map
    source_b: Map


def align(
    images_a: tuple[TextureImage, ...], images_b: tuple[TextureImage, ...], T_a_b: Array, gate_mm: float
) -> tuple[Aligned, ...]:
    """Return, per chart of a, b's texture under T_a_b; surfaces belong together within `gate_mm`."""
    return tuple(_align_one(image, len(images_a) > 1, images_b, T_a_b, gate_mm) for image in images_a)


def _align_one(
    a: TextureImage, several: bool, images_b: tuple[TextureImage, ...], T_a_b: Array, gate_mm: float
) -> Aligned:
    own = a.mask & (-a.normal_chart[..., 2] >= _FACING) if several else a.mask
    value, sigma = np.zeros(own.shape, np.float32), np.zeros(own.shape, np.float32)
    source = np.full((*own.shape, 2), np.nan, np.float32)
    facing = np.zeros(own.shape, np.float32)
    v, u = np.nonzero(own)
    points = np.column_stack([u * a.pitch_mm, v * a.pitch_mm, a.height_mm[v, u]])
    for b in images_b:
        T_chart_b = compose_chart(b, T_a_b, a)
        at = transform_points(T_chart_b, points)
        xy = np.asarray(at[:, :2] / b.pitch_mm, np.float32)
        height, width = b.mask.shape
        inside = (xy > -0.5).all(1) & (xy[:, 0] < width - 0.5) & (xy[:, 1] < height - 0.5)
        column, row = np.rint(xy[inside]).astype(int).T
        normal_a = a.normal_chart[v[inside], u[inside]] @ T_chart_b[:3, :3].T.astype(np.float32)
        normal_b = b.normal_chart[row, column]
        with np.errstate(invalid="ignore"):
            near = np.abs(at[inside, 2] - b.height_mm[row, column]) * np.abs(normal_b[:, 2]) <= gate_mm
        near &= b.mask[row, column] & ((normal_a * normal_b).sum(1) > 0)
        index = np.flatnonzero(inside)[near]
        toward = -normal_b[near, 2]
        better = toward > facing[v[index], u[index]]
        index, toward = index[better], toward[better]
        if len(index) == 0:
            continue
        rows, columns = v[index], u[index]
        facing[rows, columns] = toward
        for target, picture in ((value, b.value), (sigma, b.sigma), (source, b.source_px)):
            target[rows, columns] = sample(picture, xy[index])
    return Aligned(a, own, facing > 0, value, sigma, source)


def compose_chart(b: TextureImage, T_a_b: Array, a: TextureImage) -> Array:
    """Return the transform (4, 4) from a's chart into b's chart under T_a_b."""
    T = b.T_chart_sensor @ invert(T_a_b) @ invert(a.T_chart_sensor)
    return compose(T[:3, :3], T[:3, 3])


def sample(picture: Map, xy: Map) -> Map:
    """Return the values (N, ...) of a picture at places (N, 2) (column, row), linearly interpolated."""
    # cv2.remap cannot write more than 32767 rows: the places are laid out as a picture themselves.
    width = 1024
    padded = np.zeros((-(-len(xy) // width) * width, 2), np.float32)
    padded[: len(xy)] = xy
    maps = padded.reshape(-1, width, 2)
    drawn = cv2.remap(picture, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn.reshape(len(padded), *picture.shape[2:])[: len(xy)])
