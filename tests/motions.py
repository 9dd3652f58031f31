"""Pairs of constructed measurements in which something repeats, stands still, or moves on its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

import synthetic
from planish.geometry import exp_se3
from planish.registration.options import PairOptions
from planish.registration.pair import register_pair
from planish.registration.prepared import prepare
from planish.registration.scales import common_gsd, common_pitch, length_factor
from planish.registration.verdict.aligned import Side

#: 486 x 363 px, 0.93 mm per pixel: windows of 28 mm, some 150 of them.
SCALE = 0.35
#: T_object_sensor of b where it moved; a's is the unit matrix, so that this is also T_a_b.
T_MOVED = exp_se3([0.01, -0.02, 0.25, 70, 30, 4])
#: Width and height of the images.
SIZE_PX = synthetic.camera(SCALE).size_px
_PX_PER_MM = 1 / synthetic.RASTER_PITCH_MM
_N = round(2 * synthetic.RASTER_MM / synthetic.RASTER_PITCH_MM)


@cache
def grain(contrast=0.03, seed=1):
    """Isotropic grain, coarse enough for pixels of 0.65 mm."""
    noise = np.random.default_rng(seed).standard_normal((_N // 4, _N // 4), dtype=np.float32)
    relief = cv2.resize(cv2.GaussianBlur(noise, (0, 0), 2.0), (_N, _N), interpolation=cv2.INTER_CUBIC)
    return 1 + np.float32(contrast) * relief / relief.std()


@cache
def even():
    """No texture at all."""
    return np.ones((_N, _N), np.float32)


@cache
def chessboard(square_mm=14.0):
    """Squares of even reflectance."""
    steps = (np.arange(_N) // round(square_mm * _PX_PER_MM)) % 2
    return np.where(steps[:, None] ^ steps[None, :], np.float32(0.75), np.float32(1.25))


@cache
def repeating(period_mm=36.0, contrast=0.2):
    """A random print that repeats exactly."""
    n = round(period_mm * _PX_PER_MM)
    noise = np.random.default_rng(5).standard_normal((n, n), dtype=np.float32)
    motif = cv2.GaussianBlur(np.tile(noise, (3, 3)), (0, 0), 8.0)[n : 2 * n, n : 2 * n]
    count = -(-_N // n)
    return 1 + np.float32(contrast) * np.tile(motif / motif.std(), (count, count))[:_N, :_N]


@cache
def half_turn(contrast=0.05):
    """Grain that looks the same turned by 180 degrees."""
    one = grain(contrast, 7)
    return 1 + (one - 1 + (one - 1)[::-1, ::-1]) / np.float32(np.sqrt(2))


@cache
def sensor_pattern(prnu=0.005, spots=10):
    """What is fixed to the sensor: pixel response, dust."""
    cam = synthetic.camera(SCALE)
    width, height = cam.size_px
    rng = np.random.default_rng(11)
    pattern = 1 + prnu * rng.standard_normal((height, width))
    v, u = np.mgrid[:height, :width]
    for cu, cv, size in zip(
        rng.uniform(0, width, spots), rng.uniform(0, height, spots), rng.uniform(2, 5, spots), strict=True
    ):
        pattern *= 1 - 0.2 * np.exp(-((u - cu) ** 2 + (v - cv) ** 2) / (2 * size**2))
    return pattern


def measured(T, texture, name, seed, prnu=None):
    return synthetic.measurement(T, texture, name=name, scale=SCALE, prnu=prnu, seed=seed)


def embossed(m, height_mm=5.0, wave_px=60.0):
    """The measurement with waves in both directions on its surface."""
    v, u = np.indices(m.shape)
    relief = height_mm * np.sin(2 * np.pi * u / wave_px) * np.sin(2 * np.pi * v / wave_px)
    rays = m.points_sensor - m.camera.center_sensor
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return replace(m, points_sensor=(m.points_sensor + relief[..., None] * rays).astype(np.float32))


def composed(front, back, columns):
    """Measurement that shows `back` in the columns (slice) of the image and `front` elsewhere."""
    points, image = front.points_sensor.copy(), front.views["A"].mean.copy()
    points[:, columns] = back.points_sensor[:, columns]
    image[:, columns] = back.views["A"].mean[:, columns]
    return replace(front, points_sensor=points, views={"A": replace(front.views["A"], mean=image)})


def options(gsd_mm=0.32 / SCALE):
    """Options at this resolution."""
    return PairOptions().scaled(length_factor(gsd_mm))


def window_px():
    """Edge of a window of the verdict in pixels of the camera."""
    return options().verdict.verify.window_mm * SCALE / 0.32


def agree_mm():
    """What counts as agreement of a window [mm]."""
    return options().verdict.verify.agree_mm


def registered(a, b, pairs_in_run=1):
    """Register two measurements as a run would."""
    factor, pitch = length_factor(common_gsd([a, b])), common_pitch([a, b])
    options = PairOptions().scaled(factor)
    return register_pair(prepare(a, pitch, options, 1), prepare(b, pitch, options, 1), options, pairs_in_run, threads=1)


def side(m):
    """A measurement as the verdict sees it."""
    p = prepare(m, common_pitch([m]), options(), 1)
    return Side(m, p.images, p.contrast)


def worst_mm(T_hat, T_true, m):
    """Largest error [mm] of T_hat at the points of b."""
    points = m.points_sensor[::40, ::40].reshape(-1, 3).astype(float)
    moved = (points @ T_hat[:3, :3].T + T_hat[:3, 3]) - (points @ T_true[:3, :3].T + T_true[:3, 3])
    return float(np.nanmax(np.linalg.norm(moved, axis=1)))
