"""An unorganised cloud on the pixel grid of a camera: z-buffer and a local plane at the pixel's own ray."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from planish.errors import InputError
from planish.geometry import Array
from planish.rig import Camera

#: Points that take part in one pixel, and the fewest a plane with a residual needs.
NEIGHBOURS, MIN_NEIGHBOURS = 12, 4
#: Search radius in typical spacings of the points in the image.
RADIUS_SPACINGS = 2.2
#: Points behind the foremost by more than so many radii (as lengths on the surface) belong to a hidden surface.
LAYER_RADII = 3.0
#: Pixels whose points lie to one side would be extrapolated: largest offset of their centroid, in radii.
MAX_OFFSET_RADII = 0.45
#: Pixels worked on at a time.
CHUNK = 100_000


def render_cloud(points: Array, camera: Camera) -> tuple[Array, Array]:
    """Return points (H, W, 3) [mm] on the pixels' rays and their standard deviation (H, W) [mm]; NaN where none.

    Parameters
    ----------
    points : ndarray (N, 3)
        Points [mm] in the sensor frame.
    camera : Camera
        The camera whose pixel grid is wanted.

    Notes
    -----
    Around each pixel, the points of the foremost surface are fitted by a plane: inverse depth is linear in undistorted
    image coordinates over any plane. sigma is the fit's standard deviation from its own residual.
    """
    width, height = camera.size_px
    pixels, depth = _project(points, camera)
    if len(pixels) < NEIGHBOURS:
        raise InputError(
            "cloud", f"only {len(pixels)} points are seen by the camera", "points in the sensor frame [mm]"
        )
    tree = cKDTree(pixels)
    sample = pixels[:: max(1, len(pixels) // 20000)]
    spacing = float(np.median(tree.query(sample, k=2)[0][:, 1]))
    radius = RADIUS_SPACINGS * max(spacing, 0.5)
    grid, sigma = np.full((height * width, 3), np.nan), np.full(height * width, np.nan)
    for begin in range(0, height * width, CHUNK):
        index = np.arange(begin, min(begin + CHUNK, height * width))
        targets = np.column_stack([index % width, index // width]).astype(float)
        distance, near = tree.query(targets, k=NEIGHBOURS, distance_upper_bound=radius, workers=-1)
        use = np.isfinite(distance).sum(1) >= MIN_NEIGHBOURS
        if not use.any():
            continue
        index, targets = index[use], targets[use]
        z, sigma_z = _fit_depth(pixels, depth, near[use], targets, radius, camera.K[0, 0])
        rays = camera.rays_sensor(targets)
        grid[index] = camera.center_sensor + rays * z[:, None]
        sigma[index] = sigma_z * np.linalg.norm(rays, axis=1)
    return grid.reshape(height, width, 3), sigma.reshape(height, width)


def _project(points: Array, camera: Camera) -> tuple[Array, Array]:
    pixels = camera.project(points)
    width, height = camera.size_px
    with np.errstate(invalid="ignore"):
        inside = (pixels > -5).all(1) & (pixels[:, 0] < width + 4) & (pixels[:, 1] < height + 4)
    depth = points[inside] @ camera.T_camera_sensor[2, :3] + camera.T_camera_sensor[2, 3]
    return pixels[inside], depth


def _fit_depth(
    pixels: Array, depth: Array, near: NDArray[np.intp], targets: Array, radius: float, focal_px: float
) -> tuple[Array, Array]:
    found = near < len(pixels)
    near = np.where(found, near, 0)
    offset = (pixels[near] - targets[:, None]) / radius
    z = np.where(found, depth[near], np.inf)
    front = z.min(1)
    layer = found & (z <= (front * (1 + LAYER_RADII * radius / focal_px))[:, None])
    # Weights fall to zero at the radius, so that no point enters or leaves with a jump.
    weight = np.where(layer, np.maximum(1 - (offset**2).sum(2), 0.0) + 1e-6, 0.0)
    design = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=2)
    inverse = np.where(layer, 1 / np.where(layer, z, 1.0), 0.0)
    normal = np.einsum("nki,nk,nkj->nij", design, weight, design)
    count = layer.sum(1)
    centroid = np.einsum("nk,nkj->nj", weight, offset) / np.maximum(weight.sum(1), 1e-12)[:, None]
    good = (count >= MIN_NEIGHBOURS) & (np.linalg.norm(centroid, axis=1) <= MAX_OFFSET_RADII)
    good &= np.linalg.cond(normal) < 1e4
    result, sigma = np.full(len(z), np.nan), np.full(len(z), np.nan)
    inverted = np.linalg.inv(normal[good])
    x = np.einsum("nij,nkj,nk->ni", inverted, design[good], weight[good] * inverse[good])
    residual = np.where(layer[good], inverse[good] - np.einsum("nkj,nj->nk", design[good], x), 0.0)
    variance = (residual**2).sum(1) / np.maximum(count[good] - 3, 1)
    # Variance of the value at the pixel: noise of the points through the weights of the fit.
    gain = np.einsum("nj,nkj,nk->nk", inverted[:, 0], design[good], weight[good])
    result[good] = 1 / x[:, 0]
    relative = np.sqrt(variance * (gain**2).sum(1)) * result[good]
    sigma[good] = np.maximum(relative, np.finfo(np.float32).eps) * result[good]
    return result, sigma
