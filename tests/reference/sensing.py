"""NumPy twins of the sensing kernels: slow, plain, written from the definitions and not from the C++."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.special import erfinv
from scipy.stats import norm


def decode(stacks, angles, periods, coarse=None, start=0.0):
    """Positions (H, W) from stacks (N, H, W) per period, longest first; no limits, no saturation."""
    position = coarse
    for stack, angle, period in zip(stacks, angles, periods, strict=True):
        wave = np.tensordot(np.exp(1j * angle), stack.astype(float), 1)
        x = np.angle(wave) * period / (2 * np.pi)
        guess = start + period / 2 if position is None else position
        position = x + period * np.round((guess - x) / period)
    return position


def gray_cells(bits):
    """Cell index (H, W) from lit bits (N, H, W), most significant first."""
    index, binary = np.zeros(bits.shape[1:], int), np.zeros(bits.shape[1:], bool)
    for lit in bits:
        binary = binary ^ lit
        index = 2 * index + binary
    return index


def epipolar_crossings(position, camera, own, u, v, target):
    """All places (n, 2) where the position map of `camera` takes `target` on the epipolar curve of pixel (u, v)."""
    height, width = position.shape
    direction = own.rays_sensor(np.array([u, v], float))
    depths = np.geomspace(50, 50000, 40000)
    curve = camera.project(own.center_sensor + depths[:, None] * direction)
    curve = curve[np.isfinite(curve[:, 0])]
    order = np.argsort(curve[:, 0])
    columns = np.arange(width)
    inside = (columns >= curve[:, 0].min()) & (columns <= curve[:, 0].max())
    rows = np.interp(columns, curve[order, 0], curve[order, 1])
    top = np.floor(rows).astype(int)
    inside &= (top >= 0) & (top < height - 1)
    top = np.clip(top, 0, height - 2)
    f = rows - top
    values = np.where(inside, (1 - f) * position[top, columns] + f * position[top + 1, columns], np.nan)
    a, b = values[:-1], values[1:]
    hit = np.flatnonzero(((a <= target) & (target < b)) | ((b < target) & (target <= a)))
    share = (target - a[hit]) / (b[hit] - a[hit])
    return np.column_stack([hit + share, rows[hit] + share * (rows[hit + 1] - rows[hit])])


def triangulate(own, other, u, v, pixel):
    """Point on the ray of pixel (u, v) of `own` nearest to the ray of `pixel` of `other`, by least squares."""
    a, b = own.rays_sensor(np.array([u, v], float)), other.rays_sensor(np.asarray(pixel, float))
    between = other.center_sensor - own.center_sensor
    depths = np.linalg.lstsq(np.column_stack([a, -b]), between, rcond=None)[0]
    return own.center_sensor + depths[0] * a


def ideal_pixel(camera, pixel):
    """Where a pixel would lie without lens distortion."""
    direction = camera.T_camera_sensor[:3, :3] @ camera.rays_sensor(np.asarray(pixel, float))
    return (camera.K @ (direction / direction[2]))[:2]


def small_islands(depth, limit, least):
    """Pixels of islands with fewer than `least` pixels, by growing one region after the other."""
    todo, small = np.isfinite(depth), np.zeros(depth.shape, bool)
    while todo.any():
        region = np.zeros(depth.shape, bool)
        region[tuple(np.argwhere(todo)[0])] = True
        while True:
            grown = region.copy()
            for axis in (0, 1):
                for shift in (1, -1):
                    moved, other = np.roll(region, shift, axis), np.roll(depth, shift, axis)
                    np.moveaxis(moved, axis, 0)[0 if shift == 1 else -1] = False
                    grown |= moved & todo & (np.abs(depth - other) <= limit)
            if (grown == region).all():
                break
            region = grown
        if region.sum() < least:
            small |= region
        todo &= ~region
    return small


def grazing(depth, sigma, lit, pixel_size, max_slope, rim_px, sigmas):
    """Points of steep surfaces, and of rims whose depth depends on which part of the pixel is lit."""
    padded = np.pad(depth, 1, constant_values=np.nan)
    unlit = ~np.pad(lit, 1, constant_values=True)
    square, rim = np.zeros(depth.shape), np.zeros(depth.shape, bool)
    for axis in (0, 1):
        cut = [slice(1, -1)] * 2
        cut[axis] = slice(0, -2)
        low, near = padded[tuple(cut)], unlit[tuple(cut)]
        cut[axis] = slice(2, None)
        high, far = padded[tuple(cut)], unlit[tuple(cut)]
        both = 0.5 * (high - low)
        one = np.where(np.isnan(low), high - depth, depth - low)
        square += np.nan_to_num(np.where(np.isnan(both), one, both)) ** 2
        rim |= near | far
    change = np.sqrt(square)
    steep = change > max_slope * pixel_size * depth
    return np.isfinite(depth) & (steep | (rim & (rim_px * change > sigmas * sigma)))


def reasons_of_points(points, miss, residual, spread, rejected, low, high, limits, bits):
    """Bit mask (H, W) of what a point alone gives: no point, outside the box, rays that contradict each other."""
    max_miss, projector_px, sigmas = limits
    unmatched, outside, mismatch = bits
    valid = np.isfinite(points[..., 2])
    inside = ((points >= low) & (points <= high)).all(-1)
    result = rejected + unmatched * (~valid & (rejected == 0))
    result |= outside * (valid & ~inside)
    return result | mismatch * ((np.abs(miss) > max_miss) | (np.abs(residual) > projector_px + sigmas * spread))


def edges_of_row(p, limit):
    """Pixels beside a jump of one line: a difference that fewer than two of its four neighbours resemble."""
    d = np.diff(p)
    edge = np.zeros(len(p), bool)
    for i, step in enumerate(d):
        others = [d[j] for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(d) and np.isfinite(d[j])]
        alike = sum(abs(other - step) <= limit for other in others)
        if np.isfinite(step) and alike < min(len(others), 2):
            edge[i] = edge[i + 1] = True
    return edge


def gray_edge_positions(lit, unlit, noise):
    """Positions and sigma (H, W) between the edges along the rows; bits (n, H, W), most significant first."""
    count, height, width = lit.shape
    every = np.concatenate([lit, unlit])
    amplitude = every.max(0) - every.min(0)
    score = np.sqrt(2) * erfinv(np.clip((lit - unlit) / amplitude, -0.97, 0.97))
    variance = 2 * (noise.offset + noise.slope * (every.max(0) + every.min(0)) / 2) / amplitude**2
    cells = gray_cells(lit > unlit)
    position, sigma = np.full((height, width), np.nan), np.full((height, width), np.nan)
    for v in range(height):
        edges = []
        for u in range(width - 1):
            a, b = cells[v, u], cells[v, u + 1]
            for m in range(a + 1, b + 1) if b > a else range(a, b, -1):
                bit = count - 1 - ((m & -m).bit_length() - 1)
                p, q = score[bit, v, u], score[bit, v, u + 1]
                # ds = 2 phi(p) dp.
                dp = np.sqrt(variance[v, u : u + 2]) / (2 * norm.pdf([p, q]))
                edges.append((u + p / (p - q), m, np.hypot(q * dp[0], p * dp[1]) / (p - q) ** 2))
        for (x0, m0, s0), (x1, m1, s1) in itertools.pairwise(edges):
            for u in range(int(np.ceil(x0)), int(x1) + 1):
                w = (u - x0) / (x1 - x0)
                position[v, u] = (1 - w) * m0 + w * m1 - 0.5
                sigma[v, u] = np.hypot((1 - w) * s0, w * s1) / (x1 - x0)
    return position, sigma
