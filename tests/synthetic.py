"""Small synthetic Measurements with known truth, made without the simulator: a textured sheet seen by one camera."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from planish.geometry import Array, exp_so3, invert, transform_points
from planish.measurement import Measurement, NoiseModel, View
from planish.rig import Camera, Rig

#: Pitch of the synthetic texture raster [mm]; the raster covers +-RASTER_MM about the object's origin.
RASTER_PITCH_MM = 0.125
RASTER_MM = 400.0


def camera(scale: float = 1.0, distance_mm: float = 870.0) -> Camera:
    """A camera like the starting paper's, looking down -z at the sensor frame's origin from `distance_mm`."""
    size = (round(1388 * scale), round(1038 * scale))
    K = [[2725.8 * scale, 0, size[0] / 2 - 3.3], [0, 2725.8 * scale, size[1] / 2 + 2.1], [0, 0, 1]]
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ exp_so3([0.02, -0.3, 0.01])
    T[2, 3] = distance_mm
    return Camera.make(K, [-0.12, 0.1, 0, 0], size, T)


def raster(seed: int, contrast: float, correlation_mm: tuple[float, float] = (0.35, 1.2)) -> Array:
    """Aperiodic relative albedo of the sheet, rms `contrast`, correlation along x and y [mm]."""
    n = round(2 * RASTER_MM / RASTER_PITCH_MM)
    noise = np.random.default_rng(seed).standard_normal((n, n), dtype=np.float32)
    sx, sy = (c / RASTER_PITCH_MM / 2 for c in correlation_mm)
    grain = cv2.GaussianBlur(noise, (0, 0), sx, sigmaY=sy)
    return 1 + contrast * grain / grain.std()


def height(x: Array, y: Array, bend: float) -> Array:
    """Height of the sheet [mm]: `bend` is its curvature [1/mm] along x, half of it along y."""
    return -0.5 * bend * x**2 - 0.25 * bend * y**2


@lru_cache(maxsize=2)
def _blurred(texture_id: int, sigma: float) -> Array:
    return cv2.GaussianBlur(_TEXTURES[texture_id].astype(np.float32), (0, 0), sigma)


#: Textures by id, kept so that an id stays unique: one texture is blurred once for all measurements of it.
_TEXTURES: dict[int, Array] = {}


def _as_seen(texture: Array, scale: float) -> Array:
    """The texture averaged over a pixel's footprint."""
    _TEXTURES[id(texture)] = texture
    return _blurred(id(texture), 0.6 * 0.32 / scale / RASTER_PITCH_MM)


def measurement(
    T_object_sensor: Array,
    texture: Array,
    *,
    name: str = "m",
    scale: float = 0.5,
    bend: float = 0.0,
    grey: float = 100.0,
    noise: NoiseModel | None = None,
    sigma_mm: float = 0.03,
    prnu: Array | None = None,
    seed: int = 0,
) -> Measurement:
    """Measure the sheet: exact ray intersection (1e-10 of the ray), point noise along the ray, image noise."""
    noise = noise or NoiseModel(1.44, 1 / 40)
    cam = camera(scale)
    width, rows = cam.size_px
    rng = np.random.default_rng(seed)
    uv = np.stack(np.meshgrid(np.arange(width), np.arange(rows)), -1).astype(float)
    rays = cam.rays_sensor(uv) @ T_object_sensor[:3, :3].T
    centre = transform_points(T_object_sensor, cam.center_sensor)
    t = (0 - centre[2]) / rays[..., 2]
    for _ in range(60):
        p = centre + t[..., None] * rays
        # Newton's method along the ray on height(x, y) - z.
        slope = -bend * p[..., 0] * rays[..., 0] - 0.5 * bend * p[..., 1] * rays[..., 1] - rays[..., 2]
        step = (height(p[..., 0], p[..., 1], bend) - p[..., 2]) / slope
        t -= step
        if np.abs(step).max() < 1e-10:
            break
    p = centre + t[..., None] * rays
    column = ((p[..., 0] + RASTER_MM) / RASTER_PITCH_MM).astype(np.float32)
    row = ((p[..., 1] + RASTER_MM) / RASTER_PITCH_MM).astype(np.float32)
    image = grey * cv2.remap(_as_seen(texture, scale), column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    if prnu is not None:
        image = image * prnu
    image = image + rng.standard_normal(image.shape) * np.sqrt(noise.variance(image) / 12)
    depth_noise = rng.standard_normal(t.shape) * sigma_mm / np.linalg.norm(rays, axis=-1)
    points = transform_points(invert(T_object_sensor), centre + (t + depth_noise)[..., None] * rays)
    view = View(None, image.astype(np.float32), None, 12, noise, 250.0)
    return Measurement(
        name, "A", Rig({"A": cam}), points.astype(np.float32), np.full(t.shape, sigma_mm, np.float32),
        np.zeros(t.shape, np.uint16), None, {"A": view}, ("A",), False,
    )  # fmt: skip
