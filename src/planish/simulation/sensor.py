"""The sensor: two cameras and a projector of the starting paper, and how light becomes grey levels.

Camera positions, rotations, principal distances and points: von Enzberg, Al-Hamadi, Ghoneim, Sensors 2016, 16(3), 283.
Its rotation convention is not known here; with R = Rx Ry Rz, applied to a camera that looks along -z with image up
along +y, both optical axes pass within 9 mm of the sensor frame's origin (every other order: further away).
The distortion and the projector are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.geometry import Array, compose, exp_so3, invert
from planish.rig import Camera, Rig
from planish.sensing.patterns.entries import Entry
from planish.sensing.patterns.sequences import PROJECTOR_PX, axis_of, projector_profile

_CameraRow = tuple[tuple[float, ...], tuple[float, ...], float, tuple[float, float], tuple[float, float]]
#: position [mm], rotation [rad], principal distance [px], principal point [px] (paper); k1, k2 (ours).
PAPER_CAMERAS: dict[str, _CameraRow] = {
    "A": ((266.4, 56.7, 829.2), (-0.079, 0.311, 0.054), 2725.8, (695.7, 494.1), (-0.121, 0.093)),
    "B": ((-271.3, 57.0, 832.6), (-0.077, -0.320, -0.053), 2721.0, (678.6, 503.7), (-0.117, 0.086)),
}  # fmt: skip
CAMERA_PX = (1388, 1038)
PROJECTOR_POSITION_MM = (-2.0, 62.0, 838.0)
#: It looks below the origin, at the middle of what both cameras see, and covers that for -60 <= z <= 40 mm.
PROJECTOR_TARGET_MM = (0.0, -17.0, 0.0)
PROJECTOR_DISTANCE_PX = 1965.0
PROJECTOR_DISTORTION = (-0.04, 0.02)
#: Camera and projector frames have x right, y down, z along the view; the sensor frame x right, y up, z to the cameras.
_LOOK_DOWN = np.diag([1.0, -1.0, -1.0])
#: Samples per projector pixel of the projected profiles, and pixels they are continued over the edges.
PROFILE_SAMPLES, PROFILE_MARGIN = 16, 4


@dataclass(frozen=True)
class Sensor:
    """How radiance becomes grey levels; the defaults are the reference sensor.

    Grey levels are those of an 8-bit image; 16-bit images have the same levels in finer steps.

    Parameters
    ----------
    white_level : float
        Grey level, black level included, of a matt white-lit surface of albedo `white_albedo` at the sensor frame's
        origin that faces the projector, at `exposure` 1.
    electrons_per_level, read_noise : float
        Shot noise [electrons per grey level] and read noise [grey levels].
    noise_factor : float
        Multiplies all noise that differs between images.
    prnu : float
        Pixel response non-uniformity, standard deviation; fixed to the sensor.
    dust, projector_dust : int
        Number of dark spots on the camera sensors and on the projector, fixed to them.
    psf_px : float
        Standard deviation of the camera lens's blur [px].
    black_level : float
        Share of full scale added to every pixel.
    gamma : float
        Of the cameras: grey level = 255 (signal / 255)^(1 / gamma) + black level.
    projector_gamma : float
        Of the projector: brightness = pattern^projector_gamma.
    bits : int
        8 or 16.
    saturation : float
        Grey level at which pixels saturate.
    vignetting : float
        Loss of light in the corners of the camera images and of the projector.
    projector_blur_px, grid_depth : float
        Blur of the projector [projector px]; modulation by the dark lines between its pixels.
    samples_per_px : int
        Samples per camera pixel and axis.
    """

    white_level: float = 180.0
    white_albedo: float = 0.55
    exposure: float = 1.0
    electrons_per_level: float = 40.0
    read_noise: float = 1.2
    noise_factor: float = 1.0
    prnu: float = 0.005
    dust: int = 12
    projector_dust: int = 6
    psf_px: float = 0.6
    black_level: float = 0.02
    gamma: float = 1.0
    projector_gamma: float = 1.0
    bits: int = 8
    saturation: float = 255.0
    vignetting: float = 0.1
    projector_blur_px: float = 0.6
    grid_depth: float = 0.05
    samples_per_px: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse values without a meaning."""
        positive = (
            "white_level", "white_albedo", "exposure", "electrons_per_level", "gamma", "projector_gamma", "saturation"
        )  # fmt: skip
        for name in positive:
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(name.replace("_", " "), f"found {getattr(self, name)}", "a number above 0")
        for name in ("read_noise", "noise_factor", "prnu", "dust", "projector_dust", "psf_px", "projector_blur_px"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(name.replace("_", " "), f"found {getattr(self, name)}", "a number of at least 0")
        if self.bits not in (8, 16):
            raise InputError("bits", f"found {self.bits}", "8 or 16")


def reference_rig(scale: float = 1.0) -> Rig:
    """Return the rig of the paper with a projector between the cameras; `scale` < 1 gives coarser camera pixels."""
    cameras = {}
    for name, (position, rotation, distance, principal, distortion) in PAPER_CAMERAS.items():
        K = np.array([[distance, 0, principal[0]], [0, distance, principal[1]], [0, 0, 1.0]])
        size = (round(CAMERA_PX[0] * scale), round(CAMERA_PX[1] * scale))
        # Pixel (0, 0) is a pixel's centre: the image's corner (-1/2, -1/2) is what stays in place.
        K[:2, :2] *= scale
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
        R_sensor_camera = _euler_xyz(rotation) @ _LOOK_DOWN
        T = invert(compose(R_sensor_camera, position))
        cameras[name] = Camera.make(K, (*distortion, 0, 0), size, T, name)
    return Rig(cameras, _reference_projector())


def _reference_projector() -> Camera:
    position = np.array(PROJECTOR_POSITION_MM)
    z = PROJECTOR_TARGET_MM - position
    z /= np.linalg.norm(z)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    R_sensor_projector = np.column_stack([x, np.cross(z, x), z])
    center = ((PROJECTOR_PX[0] - 1) / 2, (PROJECTOR_PX[1] - 1) / 2)
    K = np.array([[PROJECTOR_DISTANCE_PX, 0, center[0]], [0, PROJECTOR_DISTANCE_PX, center[1]], [0, 0, 1]])
    T = invert(compose(R_sensor_projector, position))
    return Camera.make(K, (*PROJECTOR_DISTORTION, 0, 0), PROJECTOR_PX, T, "projector")


def _euler_xyz(angles: Sequence[float]) -> Array:
    R = np.eye(3)
    for axis, angle in zip(np.eye(3), angles, strict=True):
        R = R @ exp_so3(angle * axis)
    return R


@lru_cache(maxsize=8)
def sensor_response(sensor: Sensor, camera: str, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """Return what is fixed to one camera (H, W), about 1: PRNU, dust, vignetting. The same in every capture."""
    rng = np.random.Generator(np.random.Philox(key=[sensor.seed, 10 + ord(camera)]))
    width, height = size_px
    response = 1 + sensor.prnu * rng.standard_normal((height, width), np.float32)
    spots = _spots(rng, sensor.dust, size_px, (2.0, 9.0), (0.01, 0.06))
    return np.ascontiguousarray(response * spots * _vignette(size_px, sensor.vignetting), np.float32)


@lru_cache(maxsize=8)
def projector_gain(sensor: Sensor, size_px: tuple[int, int] = PROJECTOR_PX) -> NDArray[np.float32]:
    """Return what is fixed to the projector (H, W), about 1: dust and vignetting."""
    rng = np.random.Generator(np.random.Philox(key=[sensor.seed, 20]))
    spots = _spots(rng, sensor.projector_dust, size_px, (2.0, 8.0), (0.01, 0.06))
    return np.ascontiguousarray(spots * _vignette(size_px, sensor.vignetting), np.float32)


def projected_patterns(sequence: Sequence[Entry], sensor: Sensor, rig: Rig) -> dict[str, Any]:
    """Return what the projector shows for the core: blurred profiles over the projector's coordinates, and its gain."""
    assert rig.projector is not None
    size = rig.projector.size_px
    count = (max(size) + 2 * PROFILE_MARGIN) * PROFILE_SAMPLES + 1
    first = -0.5 - PROFILE_MARGIN
    coordinates = first + np.arange(count) / PROFILE_SAMPLES
    profiles = np.empty((len(sequence), count), np.float32)
    for k, entry in enumerate(sequence):
        pixels = projector_profile(entry, size) ** sensor.projector_gamma
        # A projector pixel is a square of even brightness; its lens blurs the staircase.
        stairs = pixels[np.clip(np.floor(coordinates + 0.5).astype(int), 0, len(pixels) - 1)]
        edge = np.isclose((coordinates + 0.5) % 1.0, 0.0)
        left = pixels[np.clip(np.floor(coordinates).astype(int), 0, len(pixels) - 1)]
        stairs = np.where(edge, 0.5 * (stairs + left), stairs)
        profiles[k] = _blur(stairs, sensor.projector_blur_px * PROFILE_SAMPLES)
    return {
        "profiles": profiles,
        "along_v": [int(axis_of(entry) == "v") for entry in sequence],
        "first": first,
        "samples_per_px": float(PROFILE_SAMPLES),
        "gain": projector_gain(sensor, size),
        "grid_depth": float(sensor.grid_depth),
    }


def kernel_sensor(
    sensor: Sensor, camera: str, size_px: tuple[int, int], seed: int, stream: int, exposure: float = 1.0
) -> dict[str, Any]:
    """Return the response of one camera for the core, with the sensor's exposure times `exposure`.

    `stream` names the capture, the camera and the first image of the noise.
    """
    black = sensor.black_level * 255
    return {
        "psf_px": float(sensor.psf_px),
        "supersampling": sensor.samples_per_px,
        "levels_per_radiance": float((sensor.white_level - black) / sensor.white_albedo * sensor.exposure * exposure),
        "electrons_per_level": float(sensor.electrons_per_level),
        "read_noise": float(sensor.read_noise),
        "noise_factor": float(sensor.noise_factor),
        "black_level": float(black),
        "saturation": float(min(sensor.saturation, 255.0)),
        "gamma": float(sensor.gamma),
        "quantum": 1.0 if sensor.bits == 8 else 255 / 65535,
        "response": sensor_response(sensor, camera, size_px),
        "seed": seed,
        "stream": stream,
    }


def _blur(values: Array, sigma: float) -> Array:
    if sigma <= 0:
        return values
    reach = int(np.ceil(4 * sigma))
    x = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (x / sigma) ** 2)
    return np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), "valid")


def _vignette(size_px: tuple[int, int], loss: float) -> Array:
    width, height = size_px
    x, y = (np.arange(n) / (n - 1) * 2 - 1 for n in (width, height))
    corner = np.hypot(1.0, height / width)
    radius2 = (x[None] ** 2 + (y[:, None] * height / width) ** 2) / corner**2
    return 1 - loss * radius2


def _spots(
    rng: np.random.Generator, count: int, size_px: tuple[int, int], radius_px: tuple[float, float],
    depth: tuple[float, float],
) -> Array:  # fmt: skip
    """Return a gain (H, W) with `count` soft dark discs: dust lies in front of the focal plane."""
    width, height = size_px
    gain = np.ones((height, width))
    for _ in range(count):
        u, v = rng.uniform(0, width), rng.uniform(0, height)
        radius, dark = rng.uniform(*radius_px), rng.uniform(*depth)
        reach = int(3 * radius) + 1
        columns = slice(max(0, int(u) - reach), int(u) + reach)
        rows = slice(max(0, int(v) - reach), int(v) + reach)
        x, y = np.arange(width)[columns] - u, np.arange(height)[rows, None] - v
        gain[rows, columns] *= 1 - dark / (1 + np.exp((np.hypot(x, y) / radius - 1) / 0.15))
    return gain
