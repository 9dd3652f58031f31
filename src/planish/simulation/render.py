"""From a scene to images and true points, in memory."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planish import _core
from planish.errors import InputError
from planish.geometry import Array, invert, transform_points
from planish.options import thread_count
from planish.rig import Camera
from planish.sensing.patterns.entries import Entry
from planish.simulation.light import kernel_light
from planish.simulation.scenes import Scene
from planish.simulation.sensor import kernel_sensor, projected_patterns
from planish.simulation.texture import kernel_texture

Images = NDArray[np.uint8] | NDArray[np.uint16]
Mask = NDArray[np.bool_]

#: Streams of noise per capture and camera: more images than any sequence has.
_IMAGES_PER_STREAM = 1 << 12
#: Half size [mm] of the background's texture: what a camera can see of it.
_BACKGROUND_HALF = 900.0


def render_capture(scene: Scene, index: int, threads: int | None = None) -> dict[str, Images]:
    """Return the images (N, H, W) of each camera of capture `index`, uint8 or uint16; N = length of the sequence.

    Where the entries have exposure times, the sensor's exposure is that of the longest. The bytes depend on the scene
    alone, not on the number of threads.
    """
    T = _T_object_sensor(scene, index)
    patterns = projected_patterns(scene.sequence, scene.sensor, scene.rig)
    kernel: Callable[..., None] = _core.render_images_8 if scene.sensor.bits == 8 else _core.render_images_16
    out: dict[str, Images] = {}
    for number, (name, camera) in enumerate(scene.rig.cameras.items()):
        width, height = camera.size_px
        shape = (len(scene.sequence), height, width)
        stream = (2 * index + number) * _IMAGES_PER_STREAM
        values = _kernel_scene(scene, T, name)
        images: Images = np.empty(shape, np.uint8) if scene.sensor.bits == 8 else np.empty(shape, np.uint16)
        for first, last, exposure in _runs(scene.sequence):
            sensor = kernel_sensor(scene.sensor, name, camera.size_px, scene.seed, stream + first, exposure)
            shown = patterns | {key: patterns[key][first:last] for key in ("profiles", "along_v")}
            kernel(values, shown, sensor, images[first:last], thread_count(threads))
        out[name] = images
    return out


def _runs(sequence: Sequence[Entry]) -> list[tuple[int, int, float]]:
    """Return (first, last + 1, share of the longest exposure) of successive entries of one exposure."""
    times = [1.0 if entry.exposure_ms is None else entry.exposure_ms for entry in sequence]
    starts = [k for k in range(len(times)) if k == 0 or times[k] != times[k - 1]]
    return [(a, b, times[a] / max(times)) for a, b in itertools.pairwise([*starts, len(times)])]


def true_points(scene: Scene, index: int, camera: str, threads: int | None = None) -> Array:
    """Return the true points (H, W, 3) [mm], sensor frame, at the pixel centres; NaN where the part is not seen."""
    return trace_capture(scene, index, camera, threads)[0]


def trace_capture(scene: Scene, index: int, camera: str, threads: int | None = None) -> tuple[Array, Mask]:
    """Return the true points (H, W, 3) [mm] in the sensor frame, and the pixels (H, W) that can be measured.

    A pixel can be measured where its point is lit by the projector and seen by both cameras, within their images.
    """
    T = _T_object_sensor(scene, index)
    width, height = scene.rig.cameras[camera].size_px
    points, lit = np.empty((height, width, 3)), np.empty((height, width), np.uint8)
    values = _kernel_scene(scene, T, camera)
    other = scene.rig.other(camera)
    if other is not None:
        values["other_center"] = transform_points(T, scene.rig.cameras[other].center_sensor)
    _core.trace_image(values, points, lit, thread_count(threads))
    points_sensor = np.asarray(transform_points(invert(T), points), float)
    seen = lit.astype(np.bool_)
    assert scene.rig.projector is not None
    for device in (scene.rig.projector, *([] if other is None else [scene.rig.cameras[other]])):
        seen[seen] &= _inside(device, points_sensor[seen])
    return points_sensor, seen


def _T_object_sensor(scene: Scene, index: int) -> Array:
    if not 0 <= index < len(scene.T_object_sensor):
        raise InputError("capture", f"found {index}", f"0 to {len(scene.T_object_sensor) - 1}")
    return scene.T_object_sensor[index]


def _inside(device: Camera, points_sensor: Array) -> Mask:
    pixels = device.project(points_sensor)
    limits = np.array(device.size_px) - 0.5
    return np.asarray(((pixels >= -0.5) & (pixels <= limits)).all(-1))


def _kernel_scene(scene: Scene, T_object_sensor: Array, camera: str) -> dict[str, Any]:
    surface, rig = scene.surface, scene.rig
    assert rig.projector is not None
    device = rig.cameras[camera]
    sample_mm = float(np.linalg.norm(device.center_sensor) / device.K[0, 0] / scene.sensor.samples_per_px)
    values = {
        "camera": _in_object_frame(device, T_object_sensor).kernel_parameters,
        "projector": _in_object_frame(rig.projector, T_object_sensor).kernel_parameters,
        "surface": surface.kernel_values,
        "texture": kernel_texture(scene.texture, surface.half_s, surface.half_t, scene.seed, sample_mm),
        "light": kernel_light(scene.light, rig, T_object_sensor),
    }
    if scene.printed is not None:
        values["print"] = scene.printed.kernel_values
    if scene.background is not None:
        x, y, z, origin = T_object_sensor[:3].T
        values["background"] = {
            "origin": origin + scene.background.z_mm * z,
            "axis_x": x.copy(), "axis_y": y.copy(), "normal": z.copy(),
            # The key differs from the part's, so that part and background never share their grain.
            "texture": kernel_texture(
                scene.background.texture, _BACKGROUND_HALF, _BACKGROUND_HALF, scene.sensor.seed + (1 << 32), sample_mm
            ),
        }  # fmt: skip
    return values


def _in_object_frame(camera: Camera, T_object_sensor: Array) -> Camera:
    return replace(camera, T_camera_sensor=camera.T_camera_sensor @ invert(T_object_sensor))
