"""Error along the surface: the shift of the texture of tiles that took no part in the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from planish import _core
from planish.evaluation.prepared import Prepared
from planish.geometry import Array, invert, transform_points
from planish.measurement import Map
from planish.options import thread_count
from planish.registration.tiles import held_out

#: Share of a tile's pixels that must lie in the overlap.
MIN_TILE_SHARE = 0.5
#: A shift with a larger standard deviation is no observation [px]. Most texture-free tiles stay far above: their
#: curvature is a product of independent noises.
MAX_SIGMA_PX = 0.3
#: Probability that tiles without texture pass for observations.
MAX_CHANCE = 1e-3
#: A tile that runs farther than this from the common shift found the wrong texture [px].
MAX_RUN_PX = 2.0
#: The common shift is searched for up to this far [mm]; the distance that still counts as overlap.
SEARCH_MM = 1.0
#: Steps of the search to either side; a step of a pixel is fine enough, more steps than this take too long.
MAX_SEARCH_STEPS = 6
#: Number of tiles that take part in the search for the common shift: enough for the weakest texture.
SEARCH_TILES = 48
#: Points per edge of a tile whose mean is its frame.
TILE_SAMPLES = 5
#: Fewest observations that make a root mean square.
MIN_OBSERVATIONS = 3


#: Contrast and its sigma of a and of b, then the pixel in b of each point of a.
Textures = tuple[Map, Map, Map, Map, Map]


@dataclass(frozen=True)
class TileShifts:
    """Shifts of the texture of K tiles along the surface of a.

    A shift is where T_a_b puts the texture of b, less where a has it: the error of T_a_b there, in the frame of a.

    Parameters
    ----------
    tiles : ndarray (K, 2) int
        Row and column of the tile.
    points_a : ndarray (K, 3)
        Centre of the tile [mm].
    axes_a : ndarray (K, 2, 3)
        The two tangent directions of the tile (rows, unit vectors).
    shifts_mm : ndarray (K, 2)
        Shift along the two directions [mm].
    covariances : ndarray (K, 2, 2)
        Its covariance from noise [mm^2].
    correlations : ndarray (K,)
        Correlation coefficient of the two textures after the shift.
    max_sigma_mm : float
        Components with a larger standard deviation are no observations [mm].
    """

    tiles: NDArray[np.intp]
    points_a: Array
    axes_a: Array
    shifts_mm: Array
    covariances: Array
    correlations: Array
    max_sigma_mm: float

    @property
    def vectors_a(self) -> Array:
        """Shifts (K, 3) in the frame of a [mm]."""
        return np.einsum("ki,kij->kj", self.shifts_mm, self.axes_a)

    def rms(self) -> tuple[float | None, float | None]:
        """Return the rms of the shifts [mm] and what noise alone would give [mm]; None where too little is observed.

        Each tile contributes two components, along the eigenvectors of its covariance: brushed grain fixes one and
        leaves the other open. The better ones and the worse ones are averaged apart, weighted by 1 / variance, and
        the two means of squares added; components that are no observations are left out.
        """
        if len(self.tiles) == 0:
            return None, None
        variances, vectors = np.linalg.eigh(self.covariances)
        components = np.einsum("kij,ki->kj", vectors, self.shifts_mm)
        squares = noise = 0.0
        observed = False
        for axis in range(2):
            good = variances[:, axis] < self.max_sigma_mm**2
            if np.count_nonzero(good) < MIN_OBSERVATIONS:
                continue
            weights = 1 / variances[good, axis]
            squares += float(weights @ components[good, axis] ** 2 / weights.sum())
            noise += float(np.count_nonzero(good) / weights.sum())
            observed = True
        return (float(np.sqrt(squares)), float(np.sqrt(noise))) if observed else (None, None)


def measure_tile_shifts(
    a: Prepared, b: Prepared, T_a_b: Array, distance_of_a: Map, pixels_b: Map, threads: int | None = None
) -> TileShifts:
    """Return the shifts of the held-out tiles of a.

    Parameters
    ----------
    a, b : Prepared
        The measurements.
    T_a_b : ndarray (4, 4)
        Transform under test.
    distance_of_a : ndarray (H, W of a) float32
        Distance of a's points from b's surface along b's normal [mm].
    pixels_b : ndarray (H, W of a, 2) float32
        Pixel in b of each point of a; NaN where b does not see it.
    threads : int or None
        Number of threads.
    """
    size, gsd = a.tile_size_px, a.gsd_mm
    tiles = _tiles_in_overlap(np.isfinite(pixels_b[..., 0]), size)
    points, axes, rows = _tile_frames(a, b, T_a_b, distance_of_a, tiles)
    known = np.isfinite(rows).all(1)
    tiles, points, axes, rows = tiles[known], points[known], axes[known], np.ascontiguousarray(rows[known])
    if len(tiles) == 0:
        return TileShifts(tiles, points, axes, np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0), MAX_SIGMA_PX)
    textures = (*a.contrast, *b.contrast, pixels_b)
    start = _common_shift(textures, rows, size, gsd, thread_count(threads))
    found = _core.tile_shifts(*textures, rows, size, start[0], start[1], thread_count(threads))
    good = found[:, 8] > 0
    # One factor for all tiles: that of a single tile, from some 30 blocks, is itself too noisy to weigh with.
    inflation = max(1.0, float(found[good, 9].mean())) if good.any() else 1.0
    shifts, covariances = found[:, :2], inflation * found[:, 2:6].reshape(-1, 2, 2)
    good &= found[:, 6] >= MIN_TILE_SHARE * size**2
    good &= np.linalg.norm(shifts - start, axis=1) <= MAX_RUN_PX * gsd
    best = np.linalg.eigvalsh(np.where(good[:, None, None], covariances, np.eye(2)))[:, 0]
    good &= best < (MAX_SIGMA_PX * gsd) ** 2
    if _by_chance(found[:, 7] * np.sqrt(found[:, 6]), good):
        good[:] = False
    return TileShifts(
        tiles[good], points[good], axes[good], shifts[good], covariances[good], found[good, 7], MAX_SIGMA_PX * gsd
    )


def _by_chance(significance: Array, good: NDArray[np.bool_]) -> bool:
    """Whether the tiles that are left agree no better than some of as many tiles of noise do.

    Of K standard normal variables, k that are picked after the fact have a sum over sqrt(k) beyond t with a
    probability below C(K, k) exp(-t^2 / 2).
    """
    total, kept = len(good), int(good.sum())
    picked = gammaln(total + 1) - gammaln(kept + 1) - gammaln(total - kept + 1)
    limit = np.sqrt(2 * (picked - np.log(MAX_CHANCE)))
    return kept == 0 or bool(significance[good].sum() / np.sqrt(kept) < limit)


def _tiles_in_overlap(seen: NDArray[np.bool_], size: int) -> NDArray[np.intp]:
    """Row and column (K, 2) of the whole held-out tiles that lie at least half in the overlap `seen` (H, W)."""
    rows, columns = seen.shape[0] // size, seen.shape[1] // size
    counts = seen[: rows * size, : columns * size].reshape(rows, size, columns, size).sum((1, 3))
    row, column = np.nonzero(counts >= MIN_TILE_SHARE * size**2)
    keep = held_out(row, column)
    return np.stack([row[keep], column[keep]], -1)


def _tile_frames(
    a: Prepared, b: Prepared, T_a_b: Array, distance_of_a: Map, tiles: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """Centres (K, 3), tangent directions (K, 2, 3) and kernel rows (K, 12); NaN where a tile has no surface."""
    offsets = (np.arange(TILE_SAMPLES) + 0.5) * a.tile_size_px / TILE_SAMPLES
    v = (tiles[:, :1] * a.tile_size_px + offsets).astype(int)[:, :, None]
    u = (tiles[:, 1:] * a.tile_size_px + offsets).astype(int)[:, None, :]
    smooth = (a.surface.points_sensor[v, u], a.surface.tangents_sensor[v, u], distance_of_a[v, u][..., None])
    samples = np.concatenate(smooth, -1).reshape(len(tiles), TILE_SAMPLES**2, 10)
    known = np.isfinite(samples).all(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known[..., None], samples, 0).sum(1, dtype=float) / known.sum(1)[:, None]
        points, t_u, t_v, distance = mean[:, :3], mean[:, 3:6], mean[:, 6:9], mean[:, 9:]
        e_1 = t_u / np.linalg.norm(t_u, axis=1, keepdims=True)
        e_2 = t_v - np.sum(t_v * e_1, 1, keepdims=True) * e_1
        e_2 /= np.linalg.norm(e_2, axis=1, keepdims=True)
        axes = np.stack([e_1, e_2], 1)
        # [t_u t_v] = mm per pixel of a in the tangent directions; its inverse is J_a.
        (p, q), (r, s) = np.einsum("kij,nkj->ink", axes, np.stack([t_u, t_v]))
        J_a = np.stack([s, -q, -r, p], -1) / (p * s - q * r)[:, None]
        J_b = np.stack([_pixel_motion(b, T_a_b, points, axes[:, i]) for i in range(2)], -1)
        # Where the surfaces do not coincide, the point of b that belongs to a point of a lies below it along the
        # normal, not on the camera's ray.
        offset_b = _pixel_motion(b, T_a_b, points, np.cross(e_2, e_1)) * -distance
    return points, axes, np.concatenate([tiles, J_a, J_b.reshape(-1, 4), offset_b], 1)


def _pixel_motion(b: Prepared, T_a_b: Array, points_a: Array, directions_a: Array) -> Array:
    """Motion (K, 2) of the pixels in b per mm of motion of points (K, 3) along unit vectors (K, 3) of a."""
    T_b_a = invert(T_a_b)
    ahead, behind = (transform_points(T_b_a, points_a + h * directions_a) for h in (0.5, -0.5))
    return b.measurement.camera.project(ahead) - b.measurement.camera.project(behind)


def _common_shift(textures: Textures, rows: Array, size: int, gsd: float, threads: int) -> Array:
    """Shift (2,) [mm] at which the textures of a selection of tiles agree best: by search, then least squares."""
    steps = min(max(1, round(SEARCH_MM / gsd)), MAX_SEARCH_STEPS)
    axis = np.linspace(-SEARCH_MM, SEARCH_MM, 2 * steps + 1)
    shifts = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    # Nearest to zero first: of equal scores the smaller shift wins.
    shifts = np.ascontiguousarray(shifts[np.argsort((shifts**2).sum(1), kind="stable")])
    selection = np.unique(np.linspace(0, len(rows) - 1, SEARCH_TILES).astype(int))
    rows = np.ascontiguousarray(rows[selection])
    scores = _core.shift_scores(*textures, rows, size, shifts, threads)
    best = shifts[int(np.argmax(scores[0]))]
    return np.array(_core.common_shift(*textures, rows, size, best[0], best[1], threads))
