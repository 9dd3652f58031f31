"""The development of a measurement: its texture on the flattened surface, ready for correlation."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.geometry import Array, plane_frame, transform_points
from planish.measurement import Map, Measurement
from planish.registration.dense.flatten import flatten
from planish.registration.surface import Surface
from planish.registration.tiles import ground_sample_distance

#: Distance of the nodes that are flattened [px].
_NODE_PX = 20
#: A patch of the surface smaller than this share of the largest holds too little for correlation.
_LEAST_PATCH = 0.2
#: Surface seen flatter than this has no texture left [cosine].
_MIN_COSINE = 0.3
#: Raster triangles with an edge longer than this many sample distances bridge a gap.
_MAX_EDGE_GSD = 6.0


@dataclass(frozen=True)
class Development:
    """One patch of a measurement's surface, flattened; the centre of pixel (column, row) is (column, row) * pitch_mm.

    Parameters
    ----------
    pitch_mm : float
        Size of a pixel [mm].
    value : ndarray (h, w) float32
        Local contrast over its standard deviation (white noise has variance 1 before averaging), 0 outside `mask`.
    noise : ndarray (h, w) float32
        White noise that went the same way as `value`: what the texture has to rise above.
    mask : ndarray (h, w) bool
        Where there is texture to be trusted.
    source_px : ndarray (h, w, 2) float32
        Pixel (u, v) of the organising camera; NaN outside the patch.
    """

    pitch_mm: float = field(metadata={"unit": "mm"})
    value: Map
    noise: Map
    mask: NDArray[np.bool_]
    source_px: Map = field(metadata={"unit": "px"})


def develop(
    measurement: Measurement, surface: Surface, contrast: tuple[Map, Map], pitch_mm: float
) -> tuple[Development, ...]:
    """Return the developments of all large patches of a measurement, the largest first."""
    gsd = ground_sample_distance(measurement)
    if not np.isfinite(gsd):
        return ()
    flat, patch = _flat_map(measurement, surface, gsd)
    sizes = np.bincount(patch[patch >= 0]) if (patch >= 0).any() else np.zeros(0)
    score, noise, known = _scores(contrast)
    out = []
    for number in np.flatnonzero(sizes >= _LEAST_PATCH * sizes.max(initial=1)):
        dense = _upsampled(np.where((patch == number)[..., None], flat, np.nan), measurement.shape)
        out.append(_rasterised(dense, score, noise, known, pitch_mm, gsd))
    return tuple(out)


def _flat_map(measurement: Measurement, surface: Surface, gsd: float) -> tuple[Array, NDArray[np.intp]]:
    rows, columns = _nodes(measurement.shape)
    points = surface.points_sensor[np.ix_(rows, columns)].astype(float)
    normals = surface.normals_sensor[np.ix_(rows, columns)].astype(float)
    ray = points - measurement.camera.center_sensor
    cosine = -np.einsum("hwi,hwi->hw", ray, normals) / np.linalg.norm(ray, axis=2)
    points[~(cosine > _MIN_COSINE)] = np.nan
    known = np.isfinite(points[..., 0])
    if not known.any():
        return np.full((*known.shape, 2), np.nan), np.full(known.shape, -1, np.intp)
    T = plane_frame(points[known].mean(0), -normals[known].mean(0), measurement.camera.T_camera_sensor[0, :3])
    start = np.asarray(transform_points(T, points.reshape(-1, 3))).reshape(points.shape)[..., :2]
    return flatten(points, start)


def _nodes(shape: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    rows, columns = (np.rint(np.linspace(0, n - 1, max(3, n // _NODE_PX))).astype(np.intp) for n in shape)
    return rows, columns


def _upsampled(nodes: Array, shape: tuple[int, int]) -> Map:
    """Values (H, W, 2) between the nodes, linear: NaN wherever a neighbouring node has none."""
    rows, columns = _nodes(shape)
    u = np.interp(np.arange(shape[1]), columns, np.arange(len(columns))).astype(np.float32)
    v = np.interp(np.arange(shape[0]), rows, np.arange(len(rows))).astype(np.float32)
    grid = np.meshgrid(u, v)
    return cv2.remap(nodes.astype(np.float32), *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _scores(contrast: tuple[Map, Map]) -> tuple[Map, Map, NDArray[np.bool_]]:
    """Contrast over noise, a white noise like it, and where both are to be trusted."""
    value, sigma = contrast
    with np.errstate(divide="ignore", invalid="ignore"):
        score = value / sigma
    known = np.isfinite(score)
    # Rims, highlights and dust are no Gaussian texture: a few of their values would outweigh the rest.
    spread = 1.4826 * np.median(np.abs(score[known])) if known.any() else 1.0
    wild = cv2.dilate((np.abs(score) > _WILD * spread).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    known &= ~wild & (cv2.erode(known.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0)
    score = np.where(known, np.clip(score, -_CLIP * spread, _CLIP * spread), np.float32(0))
    noise = np.random.Generator(np.random.Philox(key=_NOISE_KEY)).standard_normal(value.shape, np.float32)
    return score.astype(np.float32), np.where(known, noise, np.float32(0)), known


#: Contrast beyond this many robust deviations is left out with its neighbours, and beyond the other it is clipped.
_WILD, _CLIP = 8.0, 4.0
#: The noise is always the same.
_NOISE_KEY = 5


def _rasterised(
    flat: Map, score: Map, noise: Map, known: NDArray[np.bool_], pitch_mm: float, gsd: float
) -> Development:
    flat = flat - np.nanmin(flat, axis=(0, 1))
    # Drawn twice as fine and averaged, so that what the pitch cannot hold does not fold back.
    width, height = (2 * (int(n / pitch_mm) + 1) for n in np.nanmax(flat, axis=(0, 1)))
    source = _core.rasterise_chart(flat, 0.0, 0.0, pitch_mm / 2, _MAX_EDGE_GSD * gsd, height, width, 1)
    u, v = (np.nan_to_num(source[..., i], nan=-1e4) for i in (0, 1))

    def drawn(image: Map) -> Map:
        sampled = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return cv2.resize(sampled, (width // 2, height // 2), interpolation=cv2.INTER_AREA)

    mask = drawn(known.astype(np.float32)) > 0.99
    value, noise = (np.where(mask, drawn(image), np.float32(0)) for image in (score, noise))
    # The mean of a block's four centres is its own centre, half a fine pixel off its first one.
    centre = source.reshape(height // 2, 2, width // 2, 2, 2).mean((1, 3))
    return Development(pitch_mm, value, noise, mask, centre.astype(np.float32))
