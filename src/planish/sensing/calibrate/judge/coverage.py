"""Which parts of each image hold board points, and what their residuals have in common there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planish.geometry import Array
from planish.sensing.calibrate.judge.expected_error import in_image
from planish.sensing.calibrate.judge.point_sigmas import point_sigmas
from planish.sensing.calibrate.judge.views import depths_mm
from planish.sensing.calibrate.result import Calibration

#: Cells (rows, columns) of an image, and cells per region: nine regions, each with a name.
CELLS, REGION_CELLS = (9, 12), (3, 4)
REGIONS = (
    ("upper left", "upper middle", "upper right"),
    ("middle left", "centre", "middle right"),
    ("lower left", "lower middle", "lower right"),
)
#: A cell's mean residual counts from so many points on: fewer say more about themselves than about the place.
CELL_POINTS = 5


@dataclass(frozen=True)
class Coverage:
    """Board points over the image of one device, in cells.

    Parameters
    ----------
    device : str
        Its name.
    count : ndarray (9, 12) int
        Points that count, per cell.
    useful : ndarray (9, 12) bool
        Cells that another device sees, too, at the working distance: nothing can be measured in the others. All of
        them where there is no other device.
    mean_px : ndarray (9, 12, 2)
        Mean residual; NaN with fewer than CELL_POINTS points.
    mean_sigma_px : ndarray (9, 12)
        Standard deviation of each of its coordinates by noise; NaN likewise.
    systematic_px : float
        Root mean square (2-D) of the mean residuals beyond what noise explains [px].
    significance : float
        How many standard deviations the sum of squares of the mean residuals lies above what noise explains.
    """

    device: str
    count: NDArray[np.intp]
    useful: NDArray[np.bool_]
    mean_px: Array
    mean_sigma_px: Array
    systematic_px: float
    significance: float

    def region_shares(self) -> dict[str, float]:
        """Return per region with a useful cell the share of its useful cells that hold points."""
        out = {}
        for i, row in enumerate(REGIONS):
            for j, name in enumerate(row):
                part = np.s_[
                    i * REGION_CELLS[0] : (i + 1) * REGION_CELLS[0], j * REGION_CELLS[1] : (j + 1) * REGION_CELLS[1]
                ]
                if self.useful[part].any():
                    out[name] = float((self.count[part] > 0)[self.useful[part]].mean())
        return out


def coverage(calibration: Calibration, device: str) -> Coverage:
    """Return the coverage of one device's image, and what its residuals have in common per cell.

    Notes
    -----
    A model that does not fit leaves residuals that point the same way wherever the board stands. With noise alone,
    |mean|^2 over the variance of a coordinate of the mean is chi-square with two degrees of freedom.
    """
    size = calibration.rig.devices[device].size_px
    own = [(r.pixel_px[~r.outlier], r.residual_px[~r.outlier], sigma[~r.outlier])
           for r, sigma in point_sigmas(calibration, device)]  # fmt: skip
    pixel, residual, sigma = (np.concatenate(values) for values in zip(*own, strict=True))
    cell, cells = cell_of(pixel, size), CELLS[0] * CELLS[1]
    count = np.bincount(cell, minlength=cells)
    total = np.stack([np.bincount(cell, residual[:, k], cells) for k in (0, 1)], -1)
    enough = count >= CELL_POINTS
    known = np.where(enough, np.maximum(count, 1), np.nan)
    mean, mean_sigma = total / known[:, None], np.sqrt(np.bincount(cell, sigma**2, cells)) / known
    systematic, significance = _beyond_noise(mean[enough], mean_sigma[enough], count[enough])
    return Coverage(
        device,
        count.reshape(CELLS),
        _useful_cells(calibration, device),
        mean.reshape(*CELLS, 2),
        mean_sigma.reshape(CELLS),
        systematic,
        significance,
    )


def cell_of(pixel_px: Array, size_px: tuple[int, int]) -> NDArray[np.intp]:
    """Return the cell's number (n,), row by row, of pixels (n, 2); pixels outside count for the nearest cell."""
    share = (pixel_px + 0.5) / np.array(size_px)
    column = np.clip((share[:, 0] * CELLS[1]).astype(int), 0, CELLS[1] - 1)
    row = np.clip((share[:, 1] * CELLS[0]).astype(int), 0, CELLS[0] - 1)
    return np.asarray(row * CELLS[1] + column, np.intp)


def cell_centres(size_px: tuple[int, int]) -> Array:
    """Return the centres (9, 12, 2) of an image's cells [px]."""
    v, u = ((np.arange(n) + 0.5) / n for n in CELLS)
    return np.stack(np.meshgrid(u * size_px[0] - 0.5, v * size_px[1] - 0.5), -1)


def _beyond_noise(mean: Array, sigma: Array, count: NDArray[np.intp]) -> tuple[float, float]:
    if len(mean) == 0 or not sigma.all():
        return 0.0, 0.0
    squares = (mean**2).sum(1)
    excess = float((count * (squares - 2 * sigma**2)).sum() / count.sum())
    degrees = 2 * len(mean)
    return float(np.sqrt(max(0.0, excess))), float(((squares / sigma**2).sum() - degrees) / np.sqrt(2 * degrees))


def _useful_cells(calibration: Calibration, device: str) -> NDArray[np.bool_]:
    devices = calibration.rig.devices
    others = [camera for name, camera in devices.items() if name != device]
    if not others:
        return np.ones(CELLS, bool)
    # The sensor frame is camera A's: the plane z = working distance is parallel to its image.
    depth = depths_mm(calibration)[1]
    own = devices[device]
    rays = own.rays_sensor(cell_centres(own.size_px))
    with np.errstate(invalid="ignore", divide="ignore"):
        points = own.center_sensor + rays * ((depth - own.center_sensor[2]) / rays[..., 2])[..., None]
    flat = points.reshape(-1, 3)
    return np.any([in_image(camera, flat) for camera in others], axis=0).reshape(CELLS)
