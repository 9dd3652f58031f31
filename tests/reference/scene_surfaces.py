"""Twin of src/core/simulation/scene_surface: implicit functions, rays solved by sampling and SciPy's brentq."""

import numpy as np
from scipy.optimize import brentq


def height(surface, x, y):
    """Height z above the object's xy plane of plates, waves, door and step (wall not included)."""
    if surface.kind == "waves":
        return surface.amplitude * np.cos(2 * np.pi * x / surface.wavelength)
    if surface.kind == "step":
        return np.where(x >= 0, surface.step, 0.0)
    if surface.kind != "door":
        return np.zeros_like(x)
    d = y - surface.line_y - surface.line_slope * x
    ridge = np.exp(-(np.sqrt(d**2 + surface.line_edge**2) - surface.line_edge) / surface.line_fade)
    r = np.hypot((x - surface.recess_x) / surface.recess_half_x, (y - surface.recess_y) / surface.recess_half_y)
    recess = 1 / (1 + np.exp(np.clip((r - 1) / surface.recess_wall, None, 700)))
    bow = x**2 / (2 * surface.radius_x) + y**2 / (2 * surface.radius_y)
    return -bow + surface.line_height * ridge - surface.recess_depth * recess


def implicit(surface, points):
    """Positive outside the material."""
    x, y, z = points.T
    if surface.kind in ("cylinder", "pipe"):
        return np.hypot(x, z + surface.radius) - surface.radius
    return z - height(surface, x, y)


def first_hit(surface, origin, direction, start, end, samples=4000):
    """Distance of the first root of the implicit function between two distances, or NaN."""
    grid = np.linspace(start, end, samples)
    value = implicit(surface, origin + grid[:, None] * direction)
    inside = np.flatnonzero(value < 0)
    if len(inside) == 0 or inside[0] == 0:
        return np.nan

    def at(distance):
        return float(implicit(surface, (origin + distance * direction)[None])[0])

    return brentq(at, grid[inside[0] - 1], grid[inside[0]], xtol=1e-13, rtol=1e-15)


def normal(surface, point, step=1e-5):
    """Unit normal out of the material by central differences."""
    offsets = step * np.eye(3)
    gradient = implicit(surface, point + offsets) - implicit(surface, point - offsets)
    return gradient / np.linalg.norm(gradient)
