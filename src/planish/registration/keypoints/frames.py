"""Places of a texture image on the surface, each with a local frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from planish.geometry import Array, invert, transform_points
from planish.measurement import Map
from planish.registration.texture.resample import TextureImage

#: OpenCV's remap takes maps of fewer rows than 2^15.
_MOST_ROWS = 16384


@dataclass(frozen=True)
class SurfacePlaces:
    """N places of a texture image with an orientation.

    Parameters
    ----------
    xy : ndarray (N, 2)
        Column and row [texture px].
    angle : ndarray (N,)
        Orientation in the chart, from its x axis towards y [rad].
    frames_chart, frames_sensor : ndarray (N, 3, 3)
        Columns: orientation in the tangent plane, normal x orientation, normal.
    points_sensor : ndarray (N, 3)
        Position [mm].
    source_px : ndarray (N, 2)
        Pixel (u, v) of the organising camera.
    """

    xy: Array
    angle: Array
    frames_chart: Array
    frames_sensor: Array
    points_sensor: Array
    source_px: Array

    def __len__(self) -> int:
        return len(self.xy)


def places_on_surface(image: TextureImage, xy: Array, angle: Array) -> SurfacePlaces:
    """Return the places (N, 2) that lie on the surface, with their orientations (N,) [rad] and frames.

    A place whose height cannot be interpolated stands at the rim of the surface and is left out.
    """
    columns, rows = np.rint(xy).astype(int).T.reshape(2, -1)
    height, pixel_u, pixel_v = (
        sample(m, xy[:, :1], xy[:, 1:])[:, 0].astype(float)
        for m in (
            image.height_mm,
            np.ascontiguousarray(image.source_px[..., 0]),
            np.ascontiguousarray(image.source_px[..., 1]),
        )
    )
    known = image.mask[rows, columns] & np.isfinite(height) & np.isfinite(pixel_u) & np.isfinite(pixel_v)
    xy, angle, height = xy[known], angle[known], height[known]
    normal = image.normal_chart[rows[known], columns[known]].astype(float)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    # The orientation is measured in the chart's plane; its tangent is what projects onto it along the chart's axis.
    direction[:, 2] = -(direction[:, 0] * normal[:, 0] + direction[:, 1] * normal[:, 1]) / normal[:, 2]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    frames = np.stack([direction, np.cross(normal, direction), normal], axis=2)
    T_sensor_chart = invert(image.T_chart_sensor)
    points_chart = np.column_stack([xy * image.pitch_mm, height])
    return SurfacePlaces(
        xy, angle, frames, T_sensor_chart[:3, :3] @ frames,
        np.asarray(transform_points(T_sensor_chart, points_chart), float),
        np.column_stack([pixel_u, pixel_v])[known],
    )  # fmt: skip


def sample(image: Map, columns: Array | Map, rows: Array | Map) -> Map:
    """Values (N, S) of an image (h, w) at columns and rows (N, S), linearly interpolated; 0 outside."""
    out = np.empty(columns.shape, np.float32)
    at = columns.astype(np.float32), rows.astype(np.float32)
    for i in range(0, len(out), _MOST_ROWS):
        block = slice(i, i + _MOST_ROWS)
        out[block] = cv2.remap(image, at[0][block], at[1][block], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return out
