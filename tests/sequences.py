"""Rigs, sequences and images for the sensing tests, made without the simulator: a plane seen by two cameras."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from planish.geometry import compose, exp_so3, invert
from planish.rig import Camera, Rig
from planish.sensing.capture.manifest import Manifest
from planish.sensing.patterns.sequences import encode

PROJECTOR_PX = (320, 200)
SIZE_PX = (200, 150)
#: The lens of a test camera: standard deviation of its blur, to which a pixel's own width comes [px].
BLUR_PX = 0.6
DISTORTION = (-0.12, 0.09, 1e-3, -5e-4)


def looking_at_origin(position, focal_px, size_px, distortion=()):
    """A camera at `position` [mm] whose optical axis passes through the origin; image x along sensor x."""
    z = -np.asarray(position, float) / np.linalg.norm(position)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z]) @ exp_so3([0, 0, 0.02])
    K = [[focal_px, 0, size_px[0] / 2 + 3], [0, 1.01 * focal_px, size_px[1] / 2 - 2], [0, 0, 1]]
    return Camera.make(K, distortion, size_px, invert(compose(R, position)))


def small_rig(with_projector: bool = True) -> Rig:
    return Rig(
        {
            "A": looking_at_origin((250, 40, 820), 400, SIZE_PX, DISTORTION),
            "B": looking_at_origin((-260, 50, 840), 400, SIZE_PX, DISTORTION),
        },
        looking_at_origin((0, 60, 830), 560, PROJECTOR_PX) if with_projector else None,
    )


def plane_points(camera: Camera, tilt=(0.1, -0.05)):
    """True points (H, W, 3) of the plane z = tilt . (x, y), one per pixel."""
    u, v = np.meshgrid(np.arange(camera.size_px[0]), np.arange(camera.size_px[1]))
    rays = camera.rays_sensor(np.stack([u, v], -1))
    center, normal = camera.center_sensor, np.array([-tilt[0], -tilt[1], 1.0])
    return center - (center @ normal) / (rays @ normal)[..., None] * rays


def phase_entries(periods, steps=4, sign=1, wave="sine"):
    return [
        {"role": "phase", "period_px": p, "step": k, "steps": steps, "sign": sign, "wave": wave}
        for p in periods
        for k in range(steps)
    ]


def gray_entries(bits, cell_px, inverse=False):
    return [
        {"role": "gray", "bit": b, "cell_px": cell_px, "inverse": i}
        for b in reversed(range(bits))
        for i in ([False, True] if inverse else [False])
    ]


def manifest(sequence, **more) -> Manifest:
    names = {name: [f"{name}_{i:02d}.png" for i in range(len(sequence))] for name in "AB"}
    content = {"schema": "planish.capture/1", "rig": "rig.json", "images": names, "sequence": sequence, **more}
    return Manifest.parse(content, "capture.json")


def render(entries, positions, *, offset=40.0, amplitude=160.0, noise=None, bits=8, seed=0):
    """Images of all entries where pixel (v, u) sees projector position positions[v, u]; noise: (offset, slope)."""
    rng, scale = np.random.default_rng(seed), 1 if bits == 8 else 256
    images = []
    for entry in entries:
        grey = offset + amplitude * encode(entry, positions)
        if noise is not None:
            grey = grey + rng.standard_normal(grey.shape) * np.sqrt(noise[0] + noise[1] * grey)
        images.append(np.clip(np.round(grey * scale), 0, 255 * scale).astype(np.uint8 if bits == 8 else np.uint16))
    return images


def blurred(entries, positions, noise=None, seed=0, bits=8, offset=40.0, amplitude=160.0):
    """Images of a blurring camera whose pixel (v, u) looks at positions[v, u]."""
    rng, scale = np.random.default_rng(seed), 1 if bits == 8 else 256
    slope = np.abs(np.diff(positions[0])).min()
    fine = np.arange(positions.min() - 10, positions.max() + 10, 0.004)
    images = []
    for entry in entries:
        shown = uniform_filter1d(gaussian_filter1d(encode(entry, fine), BLUR_PX * slope / 0.004), round(slope / 0.004))
        grey = offset + amplitude * np.interp(positions, fine, shown)
        if noise is not None:
            grey = grey + rng.standard_normal(grey.shape) * np.sqrt(noise.offset + noise.slope * grey)
        images.append(np.clip(np.round(grey * scale), 0, 255 * scale).astype(np.uint8 if bits == 8 else np.uint16))
    return images
