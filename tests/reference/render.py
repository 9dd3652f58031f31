"""Twin of src/core/simulation/render: single noise-free grey values, each sample by its own ray, from the formulas."""

import numpy as np
from scipy.special import erf, ndtr

from planish.geometry import invert, transform_points
from planish.sensing.patterns.sequences import axis_of, projector_profile
from planish.simulation.sensor import projector_gain, sensor_response
from planish.simulation.texture import reflectance
from reference import surface_print


def grey_value(scene, index, camera, u, v, entry):
    """Expected grey level of one pixel before quantisation."""
    sensor, device = scene.sensor, scene.rig.cameras[camera]
    n, reach = sensor.samples_per_px, 4
    offsets = (np.arange((2 * reach + 1) * n) + 0.5) / n - 0.5 - reach
    x, y = (axis.ravel() for axis in np.meshgrid(offsets, offsets))
    weight = pixel_weight(x, sensor.psf_px) * pixel_weight(y, sensor.psf_px)
    radiance = _radiance(scene, scene.T_object_sensor[index], device, np.column_stack([u + x, v + y]), entry)
    response = sensor_response(sensor, camera, device.size_px)[v, u]
    black = 255 * sensor.black_level
    gain = (sensor.white_level - black) / sensor.white_albedo * sensor.exposure
    linear = gain * response * (weight @ radiance) / weight.sum()
    return 255 * (linear / 255) ** (1 / sensor.gamma) + black


def pixel_weight(x, psf):
    return erf((x + 0.5) / (psf * np.sqrt(2))) - erf((x - 0.5) / (psf * np.sqrt(2)))


def _radiance(scene, T, device, pixels, entry):
    eye, rays = transform_points(T, device.center_sensor), device.rays_sensor(pixels) @ T[:3, :3].T
    points, normals, st = scene.surface.intersect(np.broadcast_to(eye, rays.shape), rays)
    projector = scene.rig.projector
    source, reference = transform_points(T, projector.center_sensor), np.linalg.norm(projector.center_sensor)
    to_light, to_eye = source - points, eye - points
    distance = np.linalg.norm(to_light, axis=1)
    to_light /= distance[:, None]
    to_eye /= np.linalg.norm(to_eye, axis=1)[:, None]
    irradiance = (reference / distance) ** 2
    albedo = reflectance(scene.texture, scene.surface, st, scene.seed)
    if scene.printed is not None:
        albedo = albedo * surface_print.factor(scene.printed, st)
    light = scene.light
    cosine = (normals * to_light).sum(1)
    direct = albedo * cosine + light.specular * _ggx(normals, to_light, to_eye, light.roughness) * cosine
    room = albedo * light.ambient * (1 + points @ np.array(light.ambient_gradient_per_mm))
    if light.lamp is not None:
        lamp = np.array(light.lamp.direction) / np.linalg.norm(light.lamp.direction)
        lamp = T[:3, :3] @ lamp if light.lamp.frame == "sensor" else lamp
        lamps = np.broadcast_to(lamp, normals.shape)
        shine = albedo + light.specular * _ggx(normals, lamps, to_eye, light.roughness)
        room += light.lamp.strength * shine * (normals @ lamp)
    at = projector.project(transform_points(invert(T), points))
    return direct * irradiance * _pattern(scene.sensor, projector.size_px, entry, at) + room


def _ggx(n, light, eye, alpha):
    """D G / (4 (n l)(n v)), times pi: Walter et al. 2007 with the height-correlated Smith term of Heitz 2014."""
    half = (light + eye) / np.linalg.norm(light + eye, axis=1)[:, None]
    nl, nv, nh = ((n * v).sum(1) for v in (light, eye, half))
    tangent2 = 1 / nh**2 - 1
    distribution = 1 / (np.pi * alpha**2 * nh**4 * (1 + tangent2 / alpha**2) ** 2)

    def smith(c):
        return (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) / 2

    return np.pi * distribution / (1 + smith(nl) + smith(nv)) / (4 * nl * nv)


def _pattern(sensor, size_px, entry, at):
    values, blur = projector_profile(entry, size_px), sensor.projector_blur_px
    if not values.any():
        return 0.0
    distance = at[:, [0 if axis_of(entry) == "u" else 1]] - np.arange(len(values))
    profile = (ndtr((distance + 0.5) / blur) - ndtr((distance - 0.5) / blur)) @ values
    gain = projector_gain(sensor, size_px)
    iu, iv = np.floor(at).astype(int).T
    a, b = (at - np.floor(at)).T
    shared = (1 - b) * ((1 - a) * gain[iv, iu] + a * gain[iv, iu + 1])
    shared += b * ((1 - a) * gain[iv + 1, iu] + a * gain[iv + 1, iu + 1])
    return profile * shared * (1 + sensor.grid_depth * np.cos(2 * np.pi * at).sum(1) / 2)
