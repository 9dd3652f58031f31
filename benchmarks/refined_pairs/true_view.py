"""What one simulated capture can know of surface and texture, and how well: by the scene, not by its measurement."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from planish.geometry import Array, transform_points
from planish.rig import Camera
from planish.sensing.patterns.entries import Phase
from planish.simulation.render import render_capture, trace_capture
from planish.simulation.scenes import Scene
from planish.simulation.texture import BLANK

#: Pixels at the rim of what is measured whose gradients the rim spoils; pixels that the images are continued by.
RIM_PX, MARGIN_PX = 4, 32
#: Scale over which the texture's spectrum is averaged (standard deviation) [cycles per pixel].
RESOLUTION = 0.004
#: Step [mm] along a ray for the slope of the projector's position.
STEP_MM = 0.1
#: Phases over which fringes are averaged; those of the other half have the same levels.
PHASES = (np.arange(4) + 0.5) * np.pi / 4

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class TrueView:
    """What one capture can know, on the pixel grid (H, W) of its organising camera, in its own frame.

    Parameters
    ----------
    camera : Camera
        The organising camera.
    points, normals : ndarray (H, W, 3)
        True surface [mm].
    area : ndarray (H, W)
        Surface that a pixel covers [mm^2].
    gradient : ndarray (H, W, 3)
        Of the contrast along the surface [1/mm], each frequency by what it says about a shift.
    slope : ndarray (H, W, 3)
        By how much a surface that lies 1 mm higher moves what the rays meet, along the surface.
    texture_noise, surface_noise : ndarray (H, W)
        N and M.
    known : ndarray (H, W) bool
        Pixels that hold all of it.
    """

    camera: Camera
    points: Array
    normals: Array
    area: Map
    gradient: Array
    slope: Array
    texture_noise: Map
    surface_noise: Map
    known: Mask


def true_view(scene: Scene, index: int, valid: Mask) -> TrueView:
    """Return what capture `index` can know at its valid pixels (H, W) of camera A."""
    points, _ = trace_capture(scene, index, "A", 1)
    along = [_central(points, axis) for axis in (1, 0)]
    normals = np.cross(along[1], along[0])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    normals *= np.sign(((scene.rig.cameras["A"].center_sensor - points) * normals).sum(2))[..., None]
    levels = _levels(scene, index)
    information_N, information_M, slope = 0.0, 0.0, 0.0
    for name, camera in scene.rig.cameras.items():
        pixels = camera.project(points).astype(np.float32)
        seen = [cv2.remap(v, pixels, None, cv2.INTER_LINEAR, borderValue=(0.0,)) for v in levels[name]]
        area, step = _pixel_area(camera, points, normals), _ray_step(camera, points, normals)
        contrast, position = _pixel_information(scene, *(v.astype(float) for v in seen))
        information_N = information_N + contrast / area
        information_M = information_M + position * _position_slope(scene, points, step) ** 2 / area
        slope = slope + (contrast / area)[..., None] * (step - normals)
    with np.errstate(divide="ignore", invalid="ignore"):
        N, M, slope = 1 / information_N, 1 / information_M, slope / np.asarray(information_N)[..., None]
    area = np.linalg.norm(np.cross(*along), axis=2)
    noise = float(np.median((N / area)[valid & np.isfinite(N / area)]))
    gradient = _surface_gradient(_contrast(scene, index), along, noise)
    # A pixel whose neighbours are no surface has no gradient.
    whole = cv2.erode(valid.astype(np.uint8), np.ones((2 * RIM_PX + 1,) * 2), borderValue=(0,)).astype(bool)
    known = whole & np.isfinite(gradient.sum(2) + N + M)
    return TrueView(scene.rig.cameras["A"], points, normals, area, gradient, slope, N, M, known)


def _noiseless(scene: Scene, roles: tuple[str, ...]) -> Scene:
    sensor = replace(scene.sensor, noise_factor=0.0, prnu=0.0, bits=16)
    return replace(scene, sensor=sensor, sequence=tuple(e for e in scene.sequence if e.role in roles))


def _levels(scene: Scene, index: int) -> dict[str, tuple[Array, Array]]:
    """Return per camera grey levels (H, W) above black of the blank part: the projector's light, and the room's."""
    images = render_capture(_noiseless(replace(scene, texture=replace(BLANK, albedo=scene.texture.albedo)),
                                       ("white", "black")), index, 1)  # fmt: skip
    roles = [e.role for e in scene.sequence if e.role in ("white", "black")]
    found = {}
    for name, stack in images.items():
        white, black = (stack[roles.index(r)].astype(np.float32) * (255 / 65535) for r in ("white", "black"))
        room = black - np.float32(scene.sensor.black_level * 255)
        found[name] = (white - black, room)
    return found


def _contrast(scene: Scene, index: int) -> Array:
    """Return the contrast (H, W) of the true texture in camera A, as its lens shows it, without noise."""
    only = replace(scene, rig=replace(scene.rig, cameras={"A": scene.rig.cameras["A"]}))
    blank = replace(only, texture=replace(BLANK, albedo=scene.texture.albedo))
    textured, plain = (render_capture(_noiseless(s, ("white",)), index, 1)["A"][0].astype(float) for s in (only, blank))
    return np.asarray((textured - plain) / np.maximum(plain - scene.sensor.black_level * 65535, 1))


def _surface_gradient(contrast: Array, along: list[Array], noise: float) -> Array:
    """Return the gradient (H, W, 3) along the surface [1/mm], exact for what the pixels can hold.

    Each frequency counts by the share of its information that is left where the texture is unknown (`bound.py`);
    `noise` is the variance of one pixel's contrast.
    """
    padded = np.pad(contrast, MARGIN_PX, mode="reflect")
    spectrum = np.fft.rfft2(padded)
    reach = [RESOLUTION * n for n in padded.shape]
    S = gaussian_filter(np.abs(np.fft.fft2(padded)) ** 2, reach, mode="wrap")[:, : spectrum.shape[1]] / padded.size
    # Two captures with this noise each: S^2 / (N (2 S + N)) over S / (2 N), the unconditional over the conditional.
    spectrum *= np.sqrt(2 * S / (2 * S + noise))
    f = (np.fft.rfftfreq(padded.shape[1])[None], np.fft.fftfreq(padded.shape[0])[:, None])
    inner = slice(MARGIN_PX, -MARGIN_PX)
    c = [np.fft.irfft2(2j * np.pi * k * spectrum, padded.shape)[inner, inner] for k in f]
    # The tangents' dual basis turns derivatives by pixels into those along the surface.
    uu, uv, vv = (np.einsum("hwi,hwi->hw", p, q) for p, q in ((along[0],) * 2, tuple(along), (along[1],) * 2))
    determinant = uu * vv - uv**2
    first, second = (vv * c[0] - uv * c[1]) / determinant, (uu * c[1] - uv * c[0]) / determinant
    return np.asarray(first[..., None] * along[0] + second[..., None] * along[1])


def _central(points: Array, axis: int) -> Array:
    out = np.full_like(points, np.nan)
    inner = [slice(None)] * 2
    inner[axis] = slice(1, -1)
    ahead, behind = (np.take(points, range(*r), axis) for r in ((2, points.shape[axis]), (0, points.shape[axis] - 2)))
    out[tuple(inner)] = 0.5 * (ahead - behind)
    return out


def _pixel_area(camera: Camera, points: Array, normals: Array) -> Map:
    """Return the surface (H, W) that one pixel of a camera covers [mm^2]; the lens's distortion is left out."""
    ray = points - camera.center_sensor
    distance = np.linalg.norm(ray, axis=2)
    incidence = np.abs((ray * normals).sum(2)) / distance
    depth = transform_points(camera.T_camera_sensor, points)[..., 2]
    # Solid angle of a pixel cos^3 / (fx fy), the angle being that against the optical axis.
    return np.asarray(distance**2 * (depth / distance) ** 3 / (camera.K[0, 0] * camera.K[1, 1] * incidence))


def _ray_step(camera: Camera, points: Array, normals: Array) -> Array:
    """Return the step (H, W, 3) along the ray that leads to a surface 1 mm higher."""
    ray = points - camera.center_sensor
    return np.asarray(ray / (ray * normals).sum(2, keepdims=True))


def _position_slope(scene: Scene, points: Array, step: Array) -> Map:
    """Return the change (H, W) of the projector's position per mm that the surface lies higher [px/mm]."""
    assert scene.rig.projector is not None
    ends = [scene.rig.projector.project(points + sign * STEP_MM * step)[..., 0] for sign in (0.5, -0.5)]
    return np.asarray((ends[0] - ends[1]) / STEP_MM)


def _pixel_information(scene: Scene, projected: Map, room: Map) -> tuple[Map, Map]:
    """Return the information of one pixel's images about its contrast, and about the projector's position [1/px^2].

    Image k holds D_k (1 + c) with variance read^2 + D_k / electrons (EMVA 1288) + quantum^2 / 12: its information about
    c is D_k^2 / variance. The pixel's response, the same in all of them, adds its own variance to the estimate of c.
    The position changes D_k by projected / 2 * 2 pi / period * sine.
    """
    sensor = scene.sensor
    quantum = 1.0 if sensor.bits == 8 else 255 / 65535

    def variance(level: Map) -> Map:
        noise = sensor.read_noise**2 + np.maximum(level, 0) / sensor.electrons_per_level
        return np.asarray(sensor.noise_factor**2 * noise + quantum**2 / 12)

    contrast, position = np.zeros_like(room), np.zeros_like(room)
    for entry in (e for e in scene.sequence if not isinstance(e, Phase)):
        level = room + (projected if entry.role == "white" else 0.0)
        contrast += level**2 / variance(level)
    steps = Counter(e.period_px for e in scene.sequence if isinstance(e, Phase))
    for period, count in steps.items():
        # Lens of the projector and its pixels' own width; what the camera's lens takes off is less.
        w = 2 * np.pi / period
        amplitude = 0.5 * projected * np.exp(-0.5 * (w * sensor.projector_blur_px) ** 2) * np.sinc(1 / period)
        for phase in PHASES:
            level = room + 0.5 * projected + amplitude * np.cos(phase)
            weight = count / len(PHASES) / variance(level)
            contrast += weight * level**2
            position += weight * (amplitude * w * np.sin(phase)) ** 2
    with np.errstate(divide="ignore"):
        return 1 / (1 / contrast + sensor.prnu**2), position
