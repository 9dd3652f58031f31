from dataclasses import replace

import numpy as np
import pytest

from planish.sensing.patterns.entries import Black, White
from planish.simulation.light import Light
from planish.simulation.render import render_capture, trace_capture
from planish.simulation.scenes import Scene, make_scene
from planish.simulation.sensor import (
    CAMERA_PX,
    PAPER_CAMERAS,
    PROJECTOR_PX,
    projector_gain,
    reference_rig,
    sensor_response,
)
from planish.simulation.texture import BLANK

#: Distance at which an optical axis still counts as passing near the origin: 1 % of the working distance [mm].
NEAR_ORIGIN_MM = 9.0
#: White images for noise statistics.
IMAGES = 40


@pytest.mark.parametrize("name", ["A", "B"])
def test_the_optical_axes_pass_near_the_origin_and_look_down(name):
    camera = reference_rig().cameras[name]
    assert np.allclose(camera.center_sensor, PAPER_CAMERAS[name][0])
    axis = camera.T_camera_sensor[2, :3]
    assert axis[2] < -0.9
    assert np.linalg.norm(np.cross(axis, camera.center_sensor)) < NEAR_ORIGIN_MM


def test_the_cameras_stand_upright_and_do_not_mirror():
    for camera in reference_rig().cameras.values():
        R = camera.T_camera_sensor[:3, :3]
        assert np.linalg.det(R) == pytest.approx(1)
        right, down = R[0], R[1]
        assert right[0] > 0.9
        assert down[1] < -0.9


def test_the_resolution_on_the_part_is_that_of_the_reference_sensor():
    camera = reference_rig().cameras["A"]
    middle = camera.project(np.array([[0.0, 0, 0], [0.0, 1.0, 0]]))
    assert 1 / np.linalg.norm(middle[1] - middle[0]) == pytest.approx(0.32, abs=0.01)


@pytest.mark.parametrize("z", [-60.0, 0.0, 40.0])
def test_the_projector_covers_what_both_cameras_see(z):
    rig = reference_rig()
    u, v = np.meshgrid(np.arange(0, CAMERA_PX[0], 20.0), np.arange(0, CAMERA_PX[1], 20.0))
    rays = rig.cameras["A"].rays_sensor(np.stack([u, v], -1).reshape(-1, 2))
    center = rig.cameras["A"].center_sensor
    points = center + rays * ((z - center[2]) / rays[:, 2])[:, None]
    in_b = rig.cameras["B"].project(points)
    common = ((in_b >= 0) & (in_b < CAMERA_PX)).all(1)
    in_projector = rig.projector.project(points[common])
    assert common.mean() > 0.8
    assert ((in_projector >= 0) & (in_projector < PROJECTOR_PX)).all()


def test_a_coarser_sensor_sees_the_same_field():
    full, half = reference_rig().cameras["A"], reference_rig(0.5).cameras["A"]
    corner = full.rays_sensor(np.array([[-0.5, -0.5], [1387.5, 1037.5]]))
    assert np.allclose(half.rays_sensor(np.array([[-0.5, -0.5], [693.5, 518.5]])), corner, atol=1e-12)


def flat_scene(**changes: object) -> Scene:
    """A plate without texture, matt, in white and black, many times."""
    scene = make_scene("blank", 3, 1, scale=0.25)
    plain = {"dust": 0, "projector_dust": 0, "vignetting": 0.0, "grid_depth": 0.0, "samples_per_px": 2}
    sensor = replace(scene.sensor, **{**plain, **changes})
    sequence = (*(White(role="white") for _ in range(IMAGES)), Black(role="black"))
    return replace(
        scene, sensor=sensor, light=Light(specular=0, ambient=0), texture=BLANK, sequence=sequence,
        rig=reference_rig(0.25),
    )  # fmt: skip


def test_white_on_the_reference_albedo_gives_the_white_level_and_black_the_black_level():
    scene = flat_scene(bits=16, noise_factor=0.0, prnu=0.0)
    images = render_capture(scene, 0)["A"] * (255 / 65535)
    points, _ = trace_capture(scene, 0, "A")
    v, u = np.unravel_index(np.nanargmin(np.linalg.norm(points, axis=-1)), points.shape[:2])
    # The nearest pixel to the origin is half a pixel (0.6 mm) away; the projector leans by 4 degrees.
    assert images[0, v, u] == pytest.approx(180, rel=0.006)
    assert images[-1] == pytest.approx(5.1, abs=0.005)


def test_the_variance_of_the_noise_follows_the_model():
    scene = flat_scene(bits=16, exposure=0.8)
    images = render_capture(scene, 0)["A"][:IMAGES].astype(float) * (255 / 65535)
    mean, variance = images.mean(0), images.var(0, ddof=1)
    signal = mean - 5.1
    lit = signal > 20
    expected = 1.2**2 + signal / 40
    ratio = variance[lit] / expected[lit]
    # The variance of 40 images scatters by sqrt(2 / (IMAGES - 1)); averaged over all pixels little is left.
    assert ratio.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / (IMAGES - 1) / lit.sum()))
    assert ratio.std() == pytest.approx(np.sqrt(2 / (IMAGES - 1)), rel=0.05)
    bright, dark = signal[lit] > np.median(signal[lit]), signal[lit] <= np.median(signal[lit])
    assert ratio[bright].mean() == pytest.approx(ratio[dark].mean(), abs=0.01)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_noise_factor_scales_the_noise(factor):
    one, other = (render_capture(flat_scene(bits=16, noise_factor=f), 0)["A"][:2] for f in (1.0, factor))
    spread = [np.diff(images.astype(float), axis=0).std() for images in (one, other)]
    assert spread[1] / spread[0] == pytest.approx(factor, rel=0.02)


def test_noise_differs_between_images_cameras_and_captures():
    scene = flat_scene()
    scene = scene.seen_from([scene.T_object_sensor[0]] * 2)
    first, second = render_capture(scene, 0), render_capture(scene, 1)
    stacks = [first["A"][0], first["A"][1], second["A"][0], first["B"][0]]
    fluctuations = [stack - np.mean(first["A"][:IMAGES], axis=0) for stack in stacks[:3]]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(fluctuations[i].ravel(), fluctuations[j].ravel())[0, 1]) < 0.05
    assert not np.array_equal(stacks[0], stacks[3])


def test_what_is_fixed_to_the_sensor_is_the_same_in_every_capture():
    scene = flat_scene(noise_factor=0.1)
    scene = scene.seen_from([scene.T_object_sensor[0]] * 2)
    means = [render_capture(scene, i)["A"][:IMAGES].mean(0) for i in (0, 1)]
    lit = means[0] > 50
    pattern = [m[lit] / m[lit].mean() for m in means]
    fixed = sensor_response(scene.sensor, "A", scene.rig.cameras["A"].size_px)[lit]
    assert fixed.std() == pytest.approx(0.005, rel=0.03)
    ratio = pattern[0] / pattern[1]
    # Same place: what is left is a tenth of the noise of 40 images, far below the PRNU that cancels.
    assert ratio.std() < 0.001


def test_prnu_differs_between_cameras_and_between_sensors():
    sensor = replace(make_scene("blank", 3).sensor, vignetting=0.0, dust=0)
    a, b = (sensor_response(sensor, name, (300, 200)) for name in "AB")
    other = sensor_response(replace(sensor, seed=4), "A", (300, 200))
    for response in (b, other):
        assert abs(np.corrcoef(a.ravel(), response.ravel())[0, 1]) < 0.05


def test_dust_darkens_spots_of_camera_and_projector():
    sensor = replace(make_scene("blank", 1).sensor, prnu=0.0, vignetting=0.0, dust=5)
    response = sensor_response(sensor, "A", (400, 300))
    assert response.max() == pytest.approx(1, abs=1e-6)
    assert 0.9 < response.min() < 0.995
    assert (response < 0.995).mean() < 0.05
    assert projector_gain(sensor).min() < 0.995


def test_exposure_saturates_and_gamma_brightens_the_middle():
    hot = render_capture(flat_scene(exposure=2.0), 0)["A"][0]
    assert hot.max() == 255
    assert (hot == 255).mean() > 0.3
    linear, bent = (render_capture(flat_scene(gamma=g, noise_factor=0.0, prnu=0.0, bits=16), 0)["A"][0] for g in (1, 2))
    x = linear * (255 / 65535) - 5.1
    expected = 255 * np.sqrt(np.maximum(x, 0) / 255) + 5.1
    # Below a few grey levels the quantisation of the linear image shows.
    assert np.abs(bent * (255 / 65535) - expected)[x > 5].max() < 0.05


def test_a_saturation_level_below_full_scale_clips_there():
    assert render_capture(flat_scene(exposure=2.0, saturation=200.0), 0)["A"].max() == 200
