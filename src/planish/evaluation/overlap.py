"""The overlap of two registered measurements and how well they agree there (DESIGN section 4, "Errors").

Association is a look-up: a point of b, moved by T_a_b, is projected into a's camera and compared with a's surface at
that pixel. A point belongs to the overlap where this distance is at most 1 mm and both surfaces face the same way;
what is occluded or lies on another layer does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from planish import _core
from planish.evaluation.prepared import Prepared
from planish.evaluation.tangential import TileShifts, measure_tile_shifts
from planish.geometry import Array, invert, require_rigid
from planish.measurement import Map, Measurement
from planish.options import Options, thread_count
from planish.registration.result import OverlapError

#: Printed under every table of overlap errors.
DEFINITION = (
    "Overlap: points of b that T_a_b brings to within 1 mm of a's surface, along a's normal, seen from a's camera.",
    "Their distance is positive where b is nearer to the sensor than a.",
    "min / max: smallest and largest median of the distance over cells of 2 mm x 2 mm that are at least half filled, "
    "so that they show where the surfaces differ and not the noise of one point.",
    "rms normal: root mean square of the distance over all points, the noise of both measurements included.",
    "rms along: shift of the texture along the surface, root mean square over 10 mm tiles that took no part in the "
    "fit, each found by least squares on the texture; (noise): what the tiles' own noise alone would give.",
)


class OverlapOptions(Options):
    """Options of the comparison of two registered measurements."""

    #: A point farther than this from the other surface does not belong to the overlap [mm].
    max_distance_mm: float = Field(default=1.0, gt=0)
    #: Edge of the cells over whose medians min and max are taken [mm].
    cell_mm: float = Field(default=2.0, gt=0)
    #: Share of a cell that must lie in the overlap for it to count.
    min_cell_share: float = Field(default=0.5, gt=0, le=1)


@dataclass(frozen=True)
class OverlapEvaluation:
    """Agreement of two registered measurements.

    Parameters
    ----------
    a, b : str
        Names of the measurements.
    overlap : float
        Area of a's points within 1 mm of b over the smaller of the two areas.
    error : OverlapError or None
        Figures over the overlap; None where there is none.
    distance_mm : ndarray (H, W) float32
        Signed normal distance of b's points from a on b's pixel grid [mm]; NaN outside the overlap.
    distance_of_a_mm : ndarray (H, W) float32
        The same the other way: distance of a's points from b on a's pixel grid, positive where a is nearer to b's
        sensor than b [mm].
    tiles : TileShifts
        Shifts of the texture of single tiles along the surface.
    """

    a: str
    b: str
    overlap: float
    error: OverlapError | None
    distance_mm: Map
    distance_of_a_mm: Map
    tiles: TileShifts


def signed_distances(
    a: Prepared,
    b: Prepared,
    T_a_b: ArrayLike,
    max_distance_mm: float = 1.0,
    with_pixels: bool = False,
    threads: int | None = None,
) -> tuple[Map, Map]:
    """Return the signed distance of b's points from a's surface, and where in a's image they lie.

    Returns
    -------
    distance_mm : ndarray (H, W) float32
        On b's pixel grid [mm], positive where b is nearer to a's camera; NaN outside the overlap.
    pixels : ndarray (H, W, 2) float32, or (0, W, 2) unless `with_pixels`
        Pixel (u, v) in a's organising camera; NaN outside the overlap.
    """
    return _core.look_up_distance(
        np.ascontiguousarray(a.measurement.points_sensor, np.float32), a.surface.normals_sensor,
        a.measurement.camera.kernel_parameters, np.ascontiguousarray(b.measurement.points_sensor, np.float32),
        b.surface.normals_sensor, np.ascontiguousarray(T_a_b, float), max_distance_mm, with_pixels,
        thread_count(threads),
    )  # fmt: skip


def overlap_fraction(a: Prepared, b: Prepared, distance_of_a: Map, threads: int | None = None) -> float:
    """Return the overlap, given the distances (H, W of a) of a's points from b (NaN outside)."""
    smaller = min(a.area_mm2, b.area_mm2)
    _, _, shared = _core.known_distances(distance_of_a, a.areas_mm2, thread_count(threads))
    return min(1.0, shared / smaller) if smaller > 0 else 0.0


def evaluate_overlap(
    a: Measurement | Prepared,
    b: Measurement | Prepared,
    T_a_b: Array,
    options: OverlapOptions | None = None,
    threads: int | None = None,
) -> OverlapEvaluation:
    """Compare two measurements registered by T_a_b (4, 4); `Prepared` ones save the surface fit per measurement.

    Raises
    ------
    InputError
        Where T_a_b is no rigid transform.
    """
    options = options or OverlapOptions()
    T_a_b = require_rigid(T_a_b, "T_a_b")
    a, b = Prepared.of(a, threads), Prepared.of(b, threads)
    distance, _ = signed_distances(a, b, T_a_b, options.max_distance_mm, threads=threads)
    distance_of_a, pixels_b = signed_distances(b, a, invert(T_a_b), options.max_distance_mm, True, threads)
    tiles = measure_tile_shifts(a, b, T_a_b, distance_of_a, pixels_b, threads)
    return OverlapEvaluation(
        a.measurement.name,
        b.measurement.name,
        overlap_fraction(a, b, distance_of_a, threads),
        _summarise(b, distance, tiles, options, threads),
        distance,
        distance_of_a,
        tiles,
    )


def _summarise(
    b: Prepared, distance: Map, tiles: TileShifts, options: OverlapOptions, threads: int | None
) -> OverlapError | None:
    points, squares, _ = _core.known_distances(distance, b.areas_mm2, thread_count(threads))
    if points == 0:
        return None
    size = max(3, round(options.cell_mm / b.gsd_mm))
    medians = _core.cell_medians(distance, size, int(np.ceil(options.min_cell_share * size**2)), thread_count(threads))
    if not np.isfinite(medians).any():  # a sliver: no cell is half filled
        medians = _core.cell_medians(distance, size, 1, thread_count(threads))
    rms, sigma = tiles.rms()
    return OverlapError(
        points=points,
        min_mm=float(np.nanmin(medians)),
        max_mm=float(np.nanmax(medians)),
        rms_normal_mm=float(np.sqrt(squares / points)),
        rms_tangential_mm=rms,
        sigma_tangential_mm=sigma,
    )
