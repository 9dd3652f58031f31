"""Twin of the grain in src/core/simulation/surface_texture: cubic B-spline of hashed numbers."""

import numpy as np


def mix(x):
    x = np.asarray(x, np.uint32)
    with np.errstate(over="ignore"):
        x = (x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D)
        x = (x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B)
    return x ^ (x >> np.uint32(16))


def weights(f):
    return np.stack([(1 - f) ** 3, 4 - 6 * f**2 + 3 * f**3, 4 - 6 * (1 - f) ** 2 + 3 * (1 - f) ** 3, f**3]) / 6


def lattice_noise(x, y, seed):
    fx, fy = np.floor(x), np.floor(y)
    wx, wy = weights(x - fx), weights(y - fy)
    column, row = (v.astype(np.int64).astype(np.uint32) for v in (fx, fy))
    total = np.zeros_like(x)
    with np.errstate(over="ignore"):
        for j in range(4):
            line = mix((row + np.uint32(j)) ^ np.uint32(seed))
            for i in range(4):
                value = mix(line + (column + np.uint32(i)) * np.uint32(0x9E3779B9)).astype(np.int32)
                total += wx[i] * wy[j] * value / 2**31
    return total * np.sqrt(3) * 315 / 151


def grain(scales, s, t):
    """Relative reflectance of the grain from rows (lattice along, across [mm], angle [rad], amplitude, seed)."""
    out = np.ones_like(s)
    for along, across, angle, amplitude, seed in scales:
        x = (np.cos(angle) * s + np.sin(angle) * t) / along
        y = (-np.sin(angle) * s + np.cos(angle) * t) / across
        out += amplitude * lattice_noise(x, y, int(seed))
    return out
