"""Pairs of measurements of one sheet with known truth, for the tests of the registration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

import synthetic
from planish import _core
from planish.geometry import perturb, transform_points
from planish.measurement import NoiseModel
from planish.registration.options import PairOptions
from planish.registration.prepared import prepare

#: 347 x 260 px: every stage runs in fractions of a second.
SCALE = 0.25
#: Ground sample distance at that scale [mm], and the pitch of texture images made from it.
GSD_MM, PITCH_MM = 1.3, 1.9
SIGMA_MM = 0.03
NOISE = NoiseModel(1.44, 1 / 40)
QUIET = NoiseModel(0.0, 0.0)
#: Grain coarse enough to be seen by pixels of 1.3 mm [mm].
GRAIN_MM = (4.0, 7.0)
#: Curvature of the bent sheet [1/mm] and of one as round as a pipe.
BENT, ROUND = 1 / 800, 1 / 150
#: T_object_sensor of b; a's is the unit matrix, so that this is also T_a_b.
T_TRUE = perturb(np.eye(4), [0.02, -0.03, 0.3, 60, 25, 5], [0, 0, 0])


@cache
def grain(contrast=0.03, seed=1):
    # Drawn at a quarter of the raster's resolution: this grain holds nothing finer.
    n = round(2 * synthetic.RASTER_MM / synthetic.RASTER_PITCH_MM)
    noise = np.random.default_rng(seed).standard_normal((n // 4, n // 4), dtype=np.float32)
    sx, sy = (c / synthetic.RASTER_PITCH_MM / 8 for c in GRAIN_MM)
    relief = cv2.resize(cv2.GaussianBlur(noise, (0, 0), sx, sigmaY=sy), (n, n), interpolation=cv2.INTER_CUBIC)
    return 1 + contrast * relief / relief.std()


@cache
def quiet(side="a", bend=BENT, contrast=0.03):
    """Measurement a or b without noise (its noise model and sigma are those of a real one)."""
    T = np.eye(4) if side == "a" else T_TRUE
    m = synthetic.measurement(T, grain(contrast), name=side, scale=SCALE, bend=bend, noise=QUIET, sigma_mm=0.0)
    view = replace(m.views["A"], noise=NOISE)
    return replace(m, views={"A": view}, sigma_mm=np.full(m.shape, SIGMA_MM, np.float32))


def noisy(m, seed, factor=1.0):
    """Measurement with noise drawn by its own model, times `factor`."""
    rng = np.random.default_rng(seed)
    rays = m.points_sensor - m.camera.center_sensor
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    points = m.points_sensor + factor * m.sigma_mm[..., None] * rng.standard_normal((*m.shape, 1)) * rays
    view = m.views["A"]
    noise = NoiseModel(view.noise.offset * factor**2, view.noise.slope * factor**2)
    deviation = np.sqrt(noise.variance(view.mean) / view.mean_images)
    mean = view.mean + rng.standard_normal(m.shape) * deviation
    return replace(
        m,
        points_sensor=points.astype(np.float32),
        sigma_mm=m.sigma_mm * np.float32(factor),
        views={"A": replace(view, mean=mean.astype(np.float32), noise=noise)},
    )


@cache
def pair(bend=BENT, contrast=0.03, seed=1):
    """Two prepared measurements, T_a_b = T_TRUE."""
    return tuple(
        prepare(noisy(quiet(side, bend, contrast), seed + i), PITCH_MM, threads=2) for i, side in enumerate("ab")
    )


def errors_mm(T_hat, T_true, points_b):
    """Distances (N,) [mm] by which T_hat misplaces points of b."""
    return np.linalg.norm(transform_points(T_hat, points_b) - transform_points(T_true, points_b), axis=-1)


def texture_gradient(texture, surface):
    """Gradient (H, W, 3) of a texture (H, W) along a surface [1/mm], as the refinement sees it."""
    nothing = np.zeros(texture.shape, np.float32)
    points = surface.points_sensor
    maps = (points, nothing, surface.normals_sensor, surface.tangents_sensor, nothing, nothing, nothing)
    slopes = np.empty((0, 0, 2), np.float32)
    return _core.joint_values(maps, texture, slopes, np.zeros(3), 0.0, 0.0, 1, 2)[..., 8:11]


OPTIONS = PairOptions()
