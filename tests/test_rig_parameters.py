"""Parameters of a rig by name, their derivatives against central differences, and the covariance's way with them."""

import numpy as np
import pytest

from planish.errors import InputError
from planish.geometry import adjoint, invert, log_se3, transform_points
from planish.rig import Rig
from planish.rig.derivatives import point_derivatives, project_with_derivatives
from planish.rig.parameters import DEVICE_PARAMETERS, EXTERNAL, change_camera, selection, split_name
from planish.sensing.points.correspond import Correspondences
from planish.sensing.points.triangulate import triangulate
from planish.simulation.sensor import reference_rig

#: Central differences of float64 with steps of 1e-6: relative to the largest derivative of a parameter.
DIFFERENCE_TOLERANCE = 1e-6
#: The kernel that triangulates computes in single precision: rounding [mm], and share of the displacement.
KERNEL_MM, KERNEL_SHARE = 2e-4, 1e-3

NAMES = tuple(
    f"{device}.{name}"
    for device in ("A", "B", "projector")
    for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", *EXTERNAL)
)


@pytest.fixture(scope="module")
def rig():
    return reference_rig()


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(-130, 130, 40), rng.uniform(-90, 90, 40), rng.uniform(-40, 40, 40)])


def with_covariance(rig, names=NAMES, seed=2):
    rng = np.random.default_rng(seed)
    scale = np.array([1e-5 if "rotation" in n else 1e-3 if ".k" in n or ".p" in n else 0.05 for n in names])
    M = rng.standard_normal((len(names), len(names))) * scale[:, None] / np.sqrt(len(names))
    return Rig(rig.cameras, rig.projector, M @ M.T, tuple(names))


def test_the_derivatives_of_pixels_are_those_of_central_differences(rig, points):
    camera = change_camera(rig.cameras["A"], np.r_[np.zeros(4), 1.5, [0, 0, 1e-3, -2e-3, 0.02, 0.1, 0.05, 0.01],
                                                   [1e-3, 2e-3, -1e-3, 1e-3], np.zeros(6)])  # fmt: skip
    _, by_point, by_parameter = project_with_derivatives(camera, points)
    for k, name in enumerate(DEVICE_PARAMETERS):
        step = np.zeros(len(DEVICE_PARAMETERS))
        step[k] = 1e-6
        ahead, back = (change_camera(camera, s * step).project(points) for s in (1, -1))
        expected = (ahead - back) / 2e-6
        error = np.abs(by_parameter[..., k] - expected).max()
        assert error <= DIFFERENCE_TOLERANCE * max(1.0, np.abs(expected).max()), name
    for k in range(3):
        step = 1e-4 * np.eye(3)[k]
        expected = (camera.project(points + step) - camera.project(points - step)) / 2e-4
        np.testing.assert_allclose(by_point[..., k], expected, atol=DIFFERENCE_TOLERANCE)


def test_the_derivatives_of_points_are_those_of_triangulating_again(rig, points):
    a, b = rig.cameras["A"], rig.cameras["B"]
    columns, rows = np.meshgrid(np.arange(100, 1300, 150), np.arange(100, 1000, 150))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    shape = (a.size_px[1], a.size_px[0])
    rays = a.rays_sensor(pixels)
    seen = a.center_sensor + rays * (-a.center_sensor[2] / rays[:, 2])[:, None]
    at = pixels[:, 1], pixels[:, 0]
    pixel = np.full((*shape, 2), np.nan, np.float32)
    pixel[at] = b.project(seen)
    pairs = Correspondences(pixel, np.full(shape, 0.1, np.float32))
    found = point_derivatives(rig, "A", "B", seen, NAMES)
    for k, name in enumerate(NAMES):
        change = np.zeros(len(NAMES))
        change[k] = 1e-4 if "rotation" in name else 1e-2 if ".k" in name or ".p" in name else 1.0
        moved = [rig.changed(s * change, NAMES) for s in (1, -1)]
        ahead, back = (triangulate(pairs, m.cameras["A"], m.cameras["B"], 1).points_sensor[at] for m in moved)
        expected = (ahead.astype(float) - back) / 2
        allowed = KERNEL_MM + KERNEL_SHARE * np.abs(expected).max()
        assert np.abs(found[..., k] * change[k] - expected).max() <= allowed, name


def test_a_point_of_one_projector_axis_stays_on_its_column(rig, points):
    change = 1e-4 * np.random.default_rng(3).standard_normal(len(NAMES)) * [1e-3 if "rot" in n else 1 for n in NAMES]
    moved = rig.changed(change, NAMES)
    dx = point_derivatives(rig, "A", "projector", points, NAMES, np.array([1.0, 0.0])) @ change
    before = rig.cameras["A"].project(points), rig.projector.project(points)[:, 0]
    after = moved.cameras["A"].project(points + dx), moved.projector.project(points + dx)[:, 0]
    for x, y in zip(before, after, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-4)


def test_modes_add_up_to_the_covariance(rig):
    item = with_covariance(rig)
    modes = item.modes()
    np.testing.assert_allclose(modes.T @ modes, item.covariance, rtol=1e-6, atol=1e-12)
    assert len(Rig(rig.cameras).modes()) == 0


def test_the_covariance_in_another_frame_tells_of_the_same_rigs(rig):
    item = with_covariance(rig)
    moved = item.in_frame_of("B")
    assert not any(name.startswith("B.rotation") or name.startswith("B.translation")
                   for name in moved.covariance_parameters)  # fmt: skip
    rng = np.random.default_rng(4)
    drawn = []
    for _ in range(2000):
        change = item.modes().T @ rng.standard_normal(len(item.modes()))
        other = item.changed(change).in_frame_of("B")
        row = []
        for name in moved.covariance_parameters:
            device, _, parameter = name.partition(".")
            now, was = other.devices[device], moved.devices[device]
            xi = log_se3(now.T_camera_sensor @ np.linalg.inv(was.T_camera_sensor))
            values = dict(zip(EXTERNAL, xi, strict=True))
            values |= {"fx": now.K[0, 0] - was.K[0, 0], "fy": now.K[1, 1] - was.K[1, 1]}
            values |= {"cx": now.K[0, 2] - was.K[0, 2], "cy": now.K[1, 2] - was.K[1, 2]}
            d = now.distortion - was.distortion
            values |= dict(zip(("k1", "k2", "p1", "p2", "k3"), d[:5], strict=True))
            row.append(values[parameter])
        drawn.append(row)
    sigma = np.sqrt(np.diag(moved.covariance))
    ratio = np.cov(np.array(drawn).T) / np.outer(sigma, sigma)
    # 2000 draws: correlations scatter by 1 / sqrt(2000) = 0.022; five times that.
    np.testing.assert_allclose(ratio, moved.covariance / np.outer(sigma, sigma), atol=0.11)


def test_points_do_not_notice_the_frame_they_are_told_in(rig, points):
    item = with_covariance(rig)
    moved = item.in_frame_of("B")
    T = rig.cameras["B"].T_camera_sensor
    here = point_derivatives(item, "A", "B", points, item.covariance_parameters)
    there = point_derivatives(moved, "A", "B", transform_points(T, points), moved.covariance_parameters)
    # Distances between points are free of the frame: their variances must agree.
    pairs = np.random.default_rng(5).integers(0, len(points), (30, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    for i, j in pairs:
        d = points[i] - points[j]
        d /= np.linalg.norm(d)
        a = d @ (here[i] - here[j])
        b = (T[:3, :3] @ d) @ (there[i] - there[j])
        assert b @ moved.covariance @ b == pytest.approx(a @ item.covariance @ a, rel=1e-6)


@pytest.mark.parametrize("name", ["C.fx", "A.focal", "fx", "projector.fx"])
def test_an_unknown_parameter_is_refused(rig, name):
    with pytest.raises(InputError, match="covariance parameters: found"):
        Rig({"A": rig.cameras["A"]}).changed([1.0], (name,))


def test_parameters_of_all_devices_are_found_by_name():
    assert split_name("projector.k3", ("A", "projector")) == ("projector", DEVICE_PARAMETERS.index("k3"))
    picks = selection(("B.cy", "A.fx", "B.translation_z"), ("A", "B"))
    assert np.argwhere(picks["A"]).tolist() == [[0, 1]]
    assert np.argwhere(picks["B"]).tolist() == [[3, 0], [22, 2]]


def test_each_parameter_changes_what_its_name_says(rig):
    camera = rig.cameras["B"]
    changed = change_camera(camera, np.arange(23) * 1e-3)
    np.testing.assert_allclose(changed.K - camera.K, [[0, 4e-3, 2e-3], [0, 1e-3, 3e-3], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(changed.distortion - camera.distortion, np.arange(5, 17) * 1e-3, atol=1e-15)
    xi = log_se3(changed.T_camera_sensor @ invert(camera.T_camera_sensor))
    np.testing.assert_allclose(xi, np.arange(17, 23) * 1e-3, atol=1e-11)
    assert changed.size_px == camera.size_px


def test_a_rig_is_changed_by_its_own_parameters_or_by_named_ones(rig):
    known = with_covariance(rig, ("A.fx", "projector.cy"))
    by_own = known.changed([1.0, 2.0])
    assert by_own.cameras["A"].K[0, 0] == rig.cameras["A"].K[0, 0] + 1
    assert by_own.projector.K[1, 2] == rig.projector.K[1, 2] + 2
    assert by_own.covariance_parameters == known.covariance_parameters
    assert rig.changed([3.0], ["B.k1"]).cameras["B"].distortion[0] == rig.cameras["B"].distortion[0] + 3
    with pytest.raises(InputError, match=r"change: found .*expected 2 numbers"):
        known.changed([1.0])
    with pytest.raises(InputError, match=r"found 'C\.fx'"):
        rig.changed([1.0], ["C.fx"])


def test_exact_parameters_have_no_modes_and_a_rig_without_covariance_none(rig):
    assert rig.modes().size == 0
    partly = Rig(rig.cameras, None, np.diag([0.0, 0.04]), ("A.fx", "A.fy"))
    np.testing.assert_allclose(partly.modes() ** 2, [[0.0, 0.04]])


def test_a_rig_that_is_uncertain_of_its_own_place_alone_is_exact_in_its_camera_s_frame(rig, tmp_path):
    names = tuple(f"{device}.{name}" for device in "AB" for name in EXTERNAL)
    J = np.vstack([adjoint(rig.cameras[device].T_camera_sensor) for device in "AB"])
    moved = Rig(rig.cameras, None, J @ np.diag([1e-6] * 3 + [0.01] * 3) @ J.T, names).in_frame_of("A")
    assert not moved.covariance.any()
    assert moved.modes().size == 0
    moved.save(tmp_path / "rig.json")
    assert Rig.load(tmp_path / "rig.json").covariance_parameters == names[6:]


def test_a_rig_may_keep_the_sensor_frame_of_an_earlier_one(rig, points):
    item = with_covariance(rig).in_frame_of("A")
    kept = item.in_sensor_frame_of(rig)
    for name, device in rig.devices.items():
        np.testing.assert_allclose(kept.devices[name].project(points), device.project(points), atol=1e-9)
    T = rig.cameras["A"].T_camera_sensor
    here = point_derivatives(item, "A", "B", transform_points(T, points), item.covariance_parameters)
    there = point_derivatives(kept, "A", "B", points, kept.covariance_parameters)
    np.testing.assert_allclose(T[:3, :3] @ there, here, atol=1e-6 * np.abs(here).max())
