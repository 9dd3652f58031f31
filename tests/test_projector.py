"""One camera and a calibrated projector: points against exact geometry and the NumPy twin."""

from dataclasses import replace

import numpy as np
import pytest

from planish.errors import InputError
from planish.rig import Camera
from planish.sensing.decode import PhaseMap
from planish.sensing.points.axes import axis_between_cameras, axis_to_projector
from planish.sensing.points.projector import intersect
from reference import sensing as reference
from sequences import DISTORTION, looking_at_origin, plane_points, small_rig

#: Error of the ray by the table of shifts (1e-4 px of the camera) and single precision of positions, in projector px.
PLACE_PX = 1.7e-4
#: At 4 mm per projector px along u.
POINT_MM = 2e-3
#: 30,000 points: the standard error of a standard deviation is 0.4 %.
SPREAD = 0.02


def distorted_rig():
    rig = small_rig()
    projector = rig.projector
    return replace(rig, projector=Camera.make(projector.K, (-0.09, 0.12, 2e-3, -3e-3, 0.05), projector.size_px,
                                              projector.T_camera_sensor))  # fmt: skip


def maps_of(rig, name="A", noise=(0.0, 0.0), sigma=(0.02, 0.02), seed=0):
    camera, rng = rig.cameras[name], np.random.default_rng(seed)
    place = rig.projector.project(plane_points(camera))
    return {
        axis: phase_map(axis, place[..., i] + noise[i] * rng.standard_normal(place.shape[:2]), sigma[i])
        for i, axis in enumerate("uv")
    }


def phase_map(axis, positions, sigma):
    positions = positions.astype(np.float32)
    return PhaseMap(axis, positions, np.full_like(positions, sigma), np.zeros(positions.shape, np.uint16))


def lit(rig, name="A"):
    place = rig.projector.project(plane_points(rig.cameras[name]))
    width, height = rig.projector.size_px
    # The rim of the picture (1.5 px of the camera) is left out by the kernel.
    return (place > 3).all(-1) & (place[..., 0] < width - 4) & (place[..., 1] < height - 4)


@pytest.mark.parametrize("axes", ["u", "v", "uv"])
def test_points_are_exact_with_distortion_of_camera_and_projector(axes):
    rig = distorted_rig()
    camera, truth, inside = rig.cameras["A"], plane_points(rig.cameras["A"]), lit(rig)
    phases = {axis: phase for axis, phase in maps_of(rig).items() if axis in axes}
    primary = axes[0]
    found = intersect(phases, primary, camera, rig.projector, 2)
    error = np.linalg.norm(found.points_sensor - truth, axis=-1)
    mm_per_px = found.sigma_mm / 0.02
    assert inside.sum() > 10_000
    assert (error < PLACE_PX * mm_per_px + 2e-4)[inside].all()
    assert np.isfinite(found.miss_px[inside]).all() == (axes == "uv")


def test_kernel_equals_its_numpy_twin_for_one_and_two_axes():
    rig = distorted_rig()
    camera = rig.cameras["A"]
    phases = maps_of(rig, noise=(0.2, 0.3), sigma=(0.2, 0.3))
    phases["v"].position_px[::2] = np.nan
    found = intersect(phases, "u", camera, rig.projector, 2)
    for v, u in np.argwhere(lit(rig))[5::1777]:
        positions = np.array([phases["u"].position_px[v, u], phases["v"].position_px[v, u]], float)
        point, sigma = reference.intersect(camera, rig.projector, u, v, positions, (0.2, 0.3))
        assert np.abs(found.points_sensor[v, u] - point).max() < POINT_MM
        assert found.sigma_mm[v, u] == pytest.approx(sigma, rel=1e-3)


@pytest.mark.parametrize("axes", ["u", "uv"])
def test_sigma_states_the_scatter_along_the_ray_and_of_the_miss(axes):
    rig = distorted_rig()
    camera, inside = rig.cameras["A"], lit(rig)
    phases = {k: p for k, p in maps_of(rig, noise=(0.05, 0.08), sigma=(0.05, 0.08)).items() if k in axes}
    found = intersect(phases, "u", camera, rig.projector, 2)
    center = camera.center_sensor
    error = np.linalg.norm(found.points_sensor - center, axis=-1) - np.linalg.norm(
        plane_points(camera) - center, axis=-1
    )
    assert np.std((error / found.sigma_mm)[inside]) == pytest.approx(1.0, abs=SPREAD)
    if axes == "uv":
        assert np.std((found.miss_px / found.miss_sigma_px)[inside]) == pytest.approx(1.0, abs=SPREAD)
        assert not found.contradiction(0.0, 6.0)[inside].any()


def test_a_wrong_second_axis_is_a_contradiction():
    rig = distorted_rig()
    phases = maps_of(rig)
    phases["v"].position_px[40:60] += 3
    found = intersect(phases, "u", rig.cameras["A"], rig.projector, 1)
    wrong = found.contradiction(1.0, 5.0)
    assert wrong[40:60][lit(rig)[40:60]].all()
    assert not wrong[60:].any()
    assert not wrong[:40].any()


def test_gaps_places_behind_and_light_from_outside_the_picture_give_no_point():
    rig = distorted_rig()
    phases = maps_of(rig)
    phases["u"].position_px[10, 10:20] = np.nan
    # The ray would have to be left against its direction to reach this position.
    phases["u"].position_px[20, 10:20] = -5000
    # This far off along v, the light would come from above the projector's picture.
    phases["v"].position_px[30, 10:20] = -150
    found = intersect(phases, "u", rig.cameras["A"], rig.projector, 1)
    only_v = intersect({"v": phases["v"]}, "v", rig.cameras["A"], rig.projector, 1)
    for result in (found.points_sensor, found.sigma_mm, found.miss_px):
        assert np.isnan(result[[10, 20], 10:20]).all()
    assert np.isnan(only_v.points_sensor[30, 10:20]).all()
    assert np.isfinite(found.points_sensor[11, 10:20]).all() == lit(rig)[11, 10:20].all()


def test_the_result_does_not_depend_on_the_number_of_threads():
    rig = distorted_rig()
    phases = maps_of(rig, noise=(0.1, 0.1))
    results = [intersect(phases, "u", rig.cameras["A"], rig.projector, n) for n in (1, 2, 7)]
    for other in results[1:]:
        for name in ("points_sensor", "sigma_mm", "miss_px", "miss_sigma_px"):
            assert getattr(results[0], name).tobytes() == getattr(other, name).tobytes()


def test_the_axis_across_the_stripes_of_the_baseline_is_chosen():
    rig = small_rig()
    a, b = rig.cameras["A"], rig.cameras["B"]
    assert axis_between_cameras(maps_of(rig, "B"), a, b, "c") == "u"
    assert axis_to_projector(maps_of(rig), a, rig.projector, "c") == "u"
    above = looking_at_origin((0, 320, 820), 400, (200, 150), DISTORTION)
    vertical = replace(rig, cameras={"A": above, "B": looking_at_origin((0, -250, 800), 400, (200, 150))})
    assert axis_between_cameras(maps_of(vertical, "B"), above, vertical.cameras["B"], "c") == "v"
    assert axis_to_projector(maps_of(vertical), above, rig.projector, "c") == "v"
    # A position that is a hundred times less certain is the worse choice, though its geometry is the better one.
    assert axis_to_projector(maps_of(rig, sigma=(2.0, 0.02)), a, rig.projector, "c") == "v"


def test_stripes_along_the_baseline_are_refused_with_words():
    rig = small_rig()
    straight = replace(rig, cameras={"A": looking_at_origin((0, 320, 820), 400, (200, 150)),
                                     "B": looking_at_origin((0, -250, 800), 400, (200, 150))})  # fmt: skip
    a, b = straight.cameras["A"], straight.cameras["B"]
    only_u = {"u": maps_of(straight, "B")["u"]}
    with pytest.raises(InputError, match="run along the baseline between the two cameras"):
        axis_between_cameras(only_u, a, b, "c")
    with pytest.raises(InputError, match="run along the baseline between camera and projector"):
        axis_to_projector(only_u, a, rig.projector, "c")
    with pytest.raises(InputError, match="same place"):
        axis_to_projector(only_u, a, replace(a, size_px=(320, 200)), "c")
