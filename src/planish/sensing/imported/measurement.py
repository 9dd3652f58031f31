"""Measurements of any other scanner: a point cloud, an image and the camera that took it."""

from __future__ import annotations

import numpy as np
from pydantic import Field
from scipy.ndimage import uniform_filter

from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Measurement, View, rejection_bit
from planish.options import Options
from planish.rig import Camera, Rig
from planish.sensing.capture.images import GreyImage
from planish.sensing.imported.render_cloud import render_cloud
from planish.sensing.noise.estimate import estimate_image_noise, full_scale

#: Window of pixels over which the residual of an organised cloud is averaged.
RESIDUAL_WINDOW = 9
#: Residuals beyond so many robust standard deviations are edges, not noise.
RESIDUAL_CLIP = 4.0


class ImportOptions(Options):
    """Options of the import.

    Parameters
    ----------
    max_ray_px : float
        Largest median distance between the points of an organised cloud and the rays of their pixels.
    """

    max_ray_px: float = Field(default=0.5, gt=0)


def import_measurement(
    name: str, points: Array, image: GreyImage, rig: Rig, options: ImportOptions | None = None
) -> Measurement:
    """Return the measurement made of a cloud, an image and the camera of that image (camera A of the rig).

    Parameters
    ----------
    name : str
        Name of the measurement.
    points : ndarray (N, 3)
        Points [mm] in the sensor frame of the rig, NaN where missing. With N = W H they are taken as organised: row by
        row, one per pixel; else they are rendered through the camera onto its pixels.
    image : ndarray (H, W), uint8 or uint16
        Image of the same scene under even light.
    rig : Rig
        Camera A took the image; the rest is ignored.
    options : ImportOptions
        Default: all defaults.

    Raises
    ------
    InputError
        Where sizes contradict each other or the points do not lie in front of the camera, on their pixels' rays.
    """
    options = options or ImportOptions()
    camera = rig.cameras["A"]
    height, width = image.shape
    if (width, height) != camera.size_px:
        raise InputError(
            "image", f"is {width} x {height} px", f"{camera.size_px[0]} x {camera.size_px[1]} px, as camera A"
        )
    organised = len(points) == width * height
    if organised:
        grid = points.reshape(height, width, 3)
        _require_on_rays(grid, camera, options.max_ray_px)
        sigma = _local_sigma(grid, camera)
    else:
        grid, sigma = render_cloud(points, camera)
    valid = np.isfinite(grid[..., 2]) & np.isfinite(sigma)
    if not valid.any():
        raise InputError("cloud", "no point is seen by the camera", "points in the sensor frame of the rig [mm]")
    view = View(image.astype(np.float32), None, None, 0, estimate_image_noise(image), full_scale([image]))
    missing = rejection_bit("unmatched")
    return Measurement(
        name=name,
        organised_on="A",
        rig=Rig({"A": camera}),
        points_sensor=np.where(valid[..., None], grid, np.nan).astype(np.float32),
        sigma_mm=np.where(valid, sigma, np.nan).astype(np.float32),
        rejected=np.where(valid, np.uint16(0), missing).astype(np.uint16),
        correspondence_px=None,
        views={"A": view},
        texture_views=("A",),
        resampled=not organised,
    )


def _require_on_rays(grid: Array, camera: Camera, limit_px: float) -> None:
    v, u = np.mgrid[: grid.shape[0], : grid.shape[1]]
    off = np.linalg.norm(camera.project(grid) - np.stack([u, v], -1), axis=-1)
    seen = np.isfinite(off)
    median = float(np.median(off[seen])) if seen.any() else float("inf")
    if not median <= limit_px:
        raise InputError(
            "cloud",
            f"as many points as pixels, but they lie {median:.1f} px (median) beside the rays of their pixels",
            f"an organised cloud, row by row, of this camera (within {limit_px} px)",
        )


def _local_sigma(grid: Array, camera: Camera) -> Array:
    """Noise [mm] from what inverse depth differs from the mean of its left and right, upper and lower neighbours.

    Inverse depth is linear in the pixel over any plane, so a plane leaves nothing over.
    """
    center = camera.center_sensor
    distance = np.linalg.norm(grid - center, axis=-1)
    depth = (grid - center) @ camera.T_camera_sensor[2, :3]
    inverse = 1 / depth
    total, count = np.zeros(depth.shape), np.zeros(depth.shape)
    for axis in (0, 1):
        residual = inverse - 0.5 * (np.roll(inverse, 1, axis) + np.roll(inverse, -1, axis))
        # The first and last line have no neighbour on one side; np.roll gave them the opposite border.
        np.moveaxis(residual, axis, 0)[[0, -1]] = np.nan
        known = residual[np.isfinite(residual)]
        if not known.size:
            continue
        scale = 1.4826 * np.median(np.abs(known))
        usable = np.isfinite(residual) & (np.abs(residual) <= RESIDUAL_CLIP * scale)
        total += np.where(usable, residual, 0.0) ** 2
        count += usable
    weight = uniform_filter(count, RESIDUAL_WINDOW)
    # The mean of two neighbours has half the variance of the point itself: 3/2 in all.
    variance = uniform_filter(total, RESIDUAL_WINDOW) / np.where(weight > 1e-9, 1.5 * weight, np.nan)
    # Single precision of the file is the least there is.
    relative = np.maximum(np.sqrt(variance) * depth, np.finfo(np.float32).eps)
    return np.asarray(relative * distance)
