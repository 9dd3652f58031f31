"""Twin of src/core/simulation/surface_print: the factor of a print at single points, by nearest neighbour."""

import numpy as np


def factor(printed, st):
    """Return the factors (N,) at surface coordinates (N, 2) [mm]."""
    at = st @ printed.print_surface[:, :2].T + printed.print_surface[:, 2]
    edges = printed.x_edges_mm, printed.y_edges_mm
    for axis in (0, 1):
        if printed.repeat[axis]:
            first, last = edges[axis][0], edges[axis][-1]
            at[:, axis] = first + np.mod(at[:, axis] - first, last - first)
    column, row = (np.searchsorted(edges[axis], at[:, axis], side="right") - 1 for axis in (0, 1))
    rows, columns = printed.factors.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    out = np.ones(len(st))
    out[inside] = printed.factors[row[inside], column[inside]]
    for x, y, radius, value in printed.discs:
        out[np.hypot(at[:, 0] - x, at[:, 1] - y) <= radius] = value
    return out
