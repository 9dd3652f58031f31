"""What is printed on a surface: cells of even reflectance between straight lines, and discs; it may repeat."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from planish import _core
from planish.errors import InputError
from planish.geometry import Array, require_array


def _no_discs() -> Array:
    return np.empty((0, 4))


@dataclass(frozen=True)
class Print:
    """Factors on the reflectance of a surface, in a frame of their own on it.

    Beside the cells and discs the factor is 1. A raster is the case of equidistant lines (`raster_print`). The
    renderer averages the print over the footprint of each sample.

    Parameters
    ----------
    x_edges_mm, y_edges_mm : ndarray (columns + 1,), (rows + 1,)
        The lines between the cells [mm], ascending.
    factors : ndarray (rows, columns)
        One per cell, at least 0.
    discs : ndarray (n, 4)
        x, y, radius [mm], factor of discs on top of the cells; later ones cover earlier ones.
    print_surface : ndarray (2, 3)
        Affine map from surface coordinates (s, t, 1) [mm] to the print's (x, y) [mm]. A printer's error of scale
        stands here.
    repeat : tuple of bool
        Whether the print repeats along x, y; its period is the distance of the first line to the last. Discs that
        reach over such a line have to be given on both sides.
    """

    x_edges_mm: Array
    y_edges_mm: Array
    factors: Array
    discs: Array = field(default_factory=_no_discs)
    print_surface: Array = field(default_factory=lambda: np.eye(2, 3))
    repeat: tuple[bool, bool] = (False, False)

    def __post_init__(self) -> None:
        """Refuse what cannot be printed."""
        for name in ("x_edges_mm", "y_edges_mm"):
            edges = np.asarray(getattr(self, name), float)
            if edges.ndim != 1 or len(edges) < 2 or not np.isfinite(edges).all() or (np.diff(edges) <= 0).any():
                raise InputError(f"print: {name}", f"found {edges.tolist()}", "two and more ascending numbers [mm]")
        shape = (len(self.y_edges_mm) - 1, len(self.x_edges_mm) - 1)
        factors = require_array(self.factors, shape, "print: factors", f"factors {shape}, one per cell")
        discs = np.asarray(self.discs, float)
        wrong = discs.ndim != 2 or discs.shape[1] != 4 or not np.isfinite(discs).all()
        if wrong or (discs[:, 2] <= 0).any():
            raise InputError("print: discs", f"found {discs.tolist()}", "rows of x, y, radius > 0 [mm], factor")
        if (factors < 0).any() or (discs[:, 3] < 0).any():
            raise InputError("print: factors", "found a negative factor", "factors of at least 0")
        require_array(self.print_surface, (2, 3), "print: print_surface", "an affine map (2, 3)")

    @property
    def kernel_values(self) -> dict[str, Any]:
        """The numbers of this print for the core."""
        return {
            "x_edges": np.ascontiguousarray(self.x_edges_mm, float),
            "y_edges": np.ascontiguousarray(self.y_edges_mm, float),
            "factors": np.ascontiguousarray(self.factors, np.float32),
            "discs": np.ascontiguousarray(self.discs, float),
            "print_surface": np.ascontiguousarray(self.print_surface, float),
            "repeat_x": bool(self.repeat[0]),
            "repeat_y": bool(self.repeat[1]),
        }

    def factor(self, st: Array, footprints: Array | None = None) -> Array:
        """Return the factors (N,) at surface coordinates (N, 2) [mm].

        `footprints` (N, 4) are the derivatives of (s, t) along u and along v of the sample that averages
        (s_u, t_u, s_v, t_v) [mm]; None = the points themselves.
        """
        out = np.empty(len(st))
        spans = np.zeros((len(st), 4)) if footprints is None else np.ascontiguousarray(footprints, float)
        _core.print_factor(self.kernel_values, np.ascontiguousarray(st, float), spans, out)
        return out


def raster_print(
    factors: ArrayLike, cell_mm: tuple[float, float], origin_mm: tuple[float, float] = (0.0, 0.0),
    repeat: tuple[bool, bool] = (False, False),
) -> Print:  # fmt: skip
    """Return a raster of factors (rows, columns) with cells of `cell_mm` (x, y), read by nearest neighbour.

    The corner of its first cell lies at the surface point `origin_mm` (s, t); columns run along s, rows against t, so
    that it looks as the array is printed.

    Raises
    ------
    InputError
        Where there is no cell, or a cell has no size.
    """
    values = np.asarray(factors, float)
    if values.ndim != 2 or not values.size:
        raise InputError("print: factors", f"found shape {values.shape}", "(rows, columns) of at least 1")
    if not min(cell_mm) > 0:
        raise InputError("print: cell_mm", f"found {cell_mm}", "lengths above 0 [mm]")
    rows, columns = values.shape
    return Print(
        np.arange(columns + 1) * cell_mm[0],
        np.arange(rows + 1) * cell_mm[1],
        values,
        print_surface=np.array([[1.0, 0.0, -origin_mm[0]], [0.0, -1.0, origin_mm[1]]]),
        repeat=repeat,
    )
