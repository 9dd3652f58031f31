from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from planish.errors import InputError
from planish.geometry import is_rigid, transform_points
from planish.simulation.light import Lamp, Light
from planish.simulation.render import render_capture, trace_capture, true_points
from planish.simulation.scenes import SCENES, Background, make_scene
from planish.simulation.surfaces import Door
from planish.simulation.texture import BLANK
from reference import render as reference
from reference import scene_surfaces

#: 16-bit images are quantised to 1/257 grey level; expansion, profile table and float32 add the rest.
GREY_TOLERANCE = 0.03
#: Rays are undistorted and intersected to rounding.
PIXEL_TOLERANCE = 1e-8


def small(name, **changes):
    return make_scene(name, 2, scale=0.25, **changes)


@pytest.mark.parametrize("name", sorted(set(SCENES) - {"disjoint", "blank"}))
def test_true_points_lie_on_the_part_and_project_to_their_pixel(name):
    scene = small(name)
    for camera, device in scene.rig.cameras.items():
        points = true_points(scene, 0, camera)
        v, u = np.nonzero(np.isfinite(points[..., 2]))
        assert len(v) > 10_000
        assert np.abs(device.project(points[v, u]) - np.column_stack([u, v])).max() < PIXEL_TOLERANCE
        on_part = transform_points(scene.T_object_sensor[0], points[v, u])
        if name != "step":  # its wall is no height function
            assert np.abs(scene_surfaces.implicit(scene.surface, on_part)).max() < 2e-9


def test_measurable_pixels_are_seen_by_both_cameras_and_lit():
    scene = small("pipe")
    points, seen = trace_capture(scene, 0, "A")
    found = points[seen]
    assert 0.3 < seen.mean() < 0.95
    assert not np.isnan(found).any()
    in_object = transform_points(scene.T_object_sensor[0], found)
    normal = (in_object + [0, 0, scene.surface.radius]) * [1, 0, 1]
    for device in (scene.rig.cameras["B"], scene.rig.projector):
        pixels = device.project(found)
        assert (pixels > -0.51).all()
        assert (pixels < np.array(device.size_px) - 0.49).all()
        center = transform_points(scene.T_object_sensor[0], device.center_sensor)
        assert ((center - in_object) * normal).sum(1).min() > 0


def test_the_wall_of_a_deep_recess_hides_points_from_a_camera_and_from_the_light():
    # Steep enough that the cameras, 18 degrees to the side, do not see the foot of the far wall.
    surface = Door(recess_depth=40, recess_wall=0.02, recess_x=0, recess_y=0)
    scene = replace(small("door"), surface=surface, T_object_sensor=(np.eye(4),), names=("m1",))
    points, seen = trace_capture(scene, 0, "A")
    eyes = {"B": scene.rig.cameras["B"].center_sensor, "projector": scene.rig.projector.center_sensor}
    near = np.argwhere(np.linalg.norm(points[..., :2], axis=-1) < 100)[::7]
    blocked = 0
    for v, u in near:
        hidden = any(is_hidden(surface, points[v, u], eye) for eye in eyes.values())
        blocked += hidden
        assert seen[v, u] == (not hidden), (v, u)
    assert blocked > 20


def is_hidden(surface, point, eye):
    along = point + np.linspace(0.0, 0.25, 4000)[5:, None] * (eye - point)
    normal = scene_surfaces.normal(surface, point)
    return normal @ (eye - point) <= 0 or scene_surfaces.implicit(surface, along).min() < -1e-6


@pytest.mark.parametrize("image", [0, 8, 12, 13])
@pytest.mark.parametrize("name", ["door", "pipe"])
def test_grey_values_agree_with_the_formulas(name, image):
    scene = make_scene(name, 4, scale=0.5, bits=16)
    light = Light(specular=0.06, roughness=0.3, ambient=0.05, lamp=Lamp(0.2, (0.3, -0.2, 1.0), "sensor"))
    sensor = replace(scene.sensor, noise_factor=0.0, gamma=1.1, exposure=0.9, samples_per_px=3)
    scene = replace(scene, light=light, sensor=sensor)
    rendered = render_capture(replace(scene, sequence=(scene.sequence[image],)), 1)["B"][0] * (255 / 65535)
    rng = np.random.default_rng(image)
    places = np.column_stack([rng.integers(250, 440, 12), rng.integers(20, 500, 12)])
    expected = [reference.grey_value(scene, 1, "B", u, v, scene.sequence[image]) for u, v in places]
    assert np.abs(rendered[places[:, 1], places[:, 0]] - expected).max() < GREY_TOLERANCE


def test_the_lens_lets_through_less_of_the_fine_grain_but_keeps_its_mean():
    scene = small("plate")
    scene = replace(scene, texture=BLANK.with_grain(0.05), light=Light(specular=0, ambient=0))
    sensors = [replace(scene.sensor, psf_px=psf, noise_factor=0, prnu=0, bits=16) for psf in (0.0, 1.5)]
    sharp, soft = (render_capture(replace(scene, sensor=sensor), 1)["A"][12] for sensor in sensors)
    inside = (slice(60, 180), slice(60, 280))
    detail = [np.diff(image[inside].astype(float), axis=0).std() for image in (sharp, soft)]
    assert detail[1] < 0.6 * detail[0]
    assert sharp[inside].mean() == pytest.approx(soft[inside].mean(), rel=1e-3)


@pytest.mark.parametrize("bits", [8, 16])
def test_the_bytes_do_not_depend_on_the_number_of_threads(bits):
    scene = replace(make_scene("door", 1, scale=0.2, bits=bits), background=Background())
    one, three, eight = (render_capture(scene, 4, threads) for threads in (1, 3, 8))
    for camera in "AB":
        assert one[camera].dtype == (np.uint8 if bits == 8 else np.uint16)
        assert np.array_equal(one[camera], three[camera])
        assert np.array_equal(one[camera], eight[camera])


def test_the_seed_fixes_everything():
    first, again, other = (make_scene("door", seed, scale=0.1) for seed in (1, 1, 2))
    assert np.array_equal(first.T_object_sensor, again.T_object_sensor)
    assert not np.array_equal(first.T_object_sensor, other.T_object_sensor)
    assert np.array_equal(render_capture(first, 0)["A"], render_capture(again, 0)["A"])


def test_room_light_stays_with_the_part():
    scene = small("plate", grain=0.0, texture_density=0.0)
    light = Light(specular=0, ambient=0.2, ambient_gradient_per_mm=(1e-3, -5e-4, 0))
    quiet = replace(scene.sensor, noise_factor=0, prnu=0, dust=0, vignetting=0, bits=16)
    scene = replace(scene, light=light, sensor=quiet, sequence=(scene.sequence[13],))
    for index in (1, 3):
        # The black image shows room light only.
        image = render_capture(scene, index)["A"][0] * (255 / 65535)
        x, y, _ = np.moveaxis(transform_points(scene.T_object_sensor[index], true_points(scene, index, "A")), -1, 0)
        white = (180 - 5.1) * 0.2 * (1 + 1e-3 * x - 5e-4 * y) + 5.1
        # The lens blurs the plate's outline over four pixels.
        inside = minimum_filter(np.isfinite(white), 9, mode="constant")
        assert inside.mean() > 0.8
        assert np.abs(image - white)[inside].max() < GREY_TOLERANCE


def test_the_background_stays_with_the_sensor_and_has_no_true_point():
    scene = small("pipe")
    scene = replace(scene, background=Background(), sensor=replace(scene.sensor, noise_factor=0))
    first, second = (render_capture(scene, i)["A"][12].astype(float) for i in (0, 2))
    missing = np.isnan(true_points(scene, 0, "A")[..., 0]) & np.isnan(true_points(scene, 2, "A")[..., 0])
    # Away from the pipe, which shades and blurs its surroundings.
    far = missing[:, :40].all(1)
    assert far.sum() > 50
    a, b = first[far, :40].ravel(), second[far, :40].ravel()
    assert a.std() > 1
    assert np.corrcoef(a, b)[0, 1] > 0.95


@pytest.mark.parametrize("name", sorted(SCENES))
def test_every_scene_has_rigid_places_that_see_the_part(name):
    scene = make_scene(name, 0, scale=0.1)
    assert all(is_rigid(T) for T in scene.T_object_sensor)
    assert len(set(scene.names)) == len(scene.names) == len(scene.T_object_sensor)
    for index in range(len(scene.names)):
        assert trace_capture(scene, index, "A")[1].mean() > 0.4


def test_consecutive_captures_of_the_demo_overlap_by_about_forty_percent():
    for seed in range(3):
        assert np.abs(overlaps(make_scene("door", seed, scale=0.1)) - 0.4).max() < 0.15


def test_disjoint_captures_do_not_overlap():
    for seed in range(3):
        assert overlaps(make_scene("disjoint", seed, scale=0.1)).max() == 0


def overlaps(scene):
    """Share of the smaller area that consecutive captures share, on a raster of 10 mm over the part."""
    cells = []
    for index in range(len(scene.names)):
        points, seen = trace_capture(scene, index, "A")
        in_object = transform_points(scene.T_object_sensor[index], points[seen])
        cells.append({tuple(cell) for cell in np.floor(in_object[:, :2] / 10).astype(int)})
    return np.array([len(a & b) / min(len(a), len(b)) for a, b in pairwise(cells)])


@pytest.mark.parametrize(
    "values",
    [
        {"name": "spoon"}, {"captures": 0}, {"seed": -1}, {"grain": 1.0}, {"grain": -0.1}, {"texture_density": -1.0},
        {"scale": 0.0}, {"bits": 12}, {"name": "disjoint", "captures": 3},
    ],
)  # fmt: skip
def test_scenes_refuse_what_they_cannot_do(values):
    with pytest.raises(InputError, match="expected"):
        make_scene(**{"name": "door", **values})


def test_a_capture_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match="0 to 1"):
        render_capture(make_scene("blank", 0, scale=0.1), 2)


def test_a_wall_thinner_than_the_samples_is_a_continuous_line():
    scene = make_scene("step", 3, scale=0.5, bits=16, grain=0.0, texture_density=0.0)
    scene = replace(scene, sensor=replace(scene.sensor, noise_factor=0, prnu=0, dust=0, projector_dust=0))
    image = render_capture(replace(scene, sequence=(scene.sequence[12],)), 0)["B"][0].astype(float)
    # Light missing around x = 0, row by row: 20 degrees to the side the wall is a dark strip of 0.07 mm, 0.11 px.
    in_object = transform_points(scene.T_object_sensor[0], true_points(scene, 0, "B"))
    edge = np.nanargmin(np.abs(in_object[..., 0]), axis=1)
    missing = []
    for v in range(60, 460):
        distance = np.arange(-12, 13)
        line, near = image[v, edge[v] + distance], np.abs(distance) <= 4
        smooth = np.polyval(np.polyfit(distance[~near], line[~near], 2), distance)
        missing.append((1 - line / smooth).sum())
    # One ray per sample would miss the wall or show it whole: zero or a quarter of a pixel.
    assert 0.07 < np.mean(missing) < 0.17
    assert np.std(missing) < 0.05
