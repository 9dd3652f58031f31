"""Rigid transforms: round trips over the whole range, also where closed forms lose digits; covariance by sampling."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from planish import geometry
from planish.errors import InputError

#: Rounding of a few float64 operations on rotations, and on translations of up to 2 m.
ROTATION_TOLERANCE = 1e-12
TRANSLATION_TOLERANCE_MM = 1e-9
#: Next to a half turn the axis is known to the root of the rounding only, its effect on R is not.
HALF_TURN_TOLERANCE = 1e-7

components = st.floats(-1.0, 1.0, allow_subnormal=False)
axes = st.tuples(components, components, components).map(np.array).filter(lambda v: np.linalg.norm(v) > 1e-3)
units = axes.map(lambda v: v / np.linalg.norm(v))
angles = st.one_of(
    st.floats(0.0, np.pi),
    st.floats(-12.0, -2.0).map(lambda e: 10.0**e),
    st.floats(-12.0, -2.0).map(lambda e: np.pi - 10.0**e),
    st.sampled_from([0.0, geometry.SMALL_ANGLE, geometry.SMALL_ANGLE * (1 + 1e-9), np.pi]),
)
points = st.tuples(*[st.floats(-2000.0, 2000.0)] * 3).map(np.array)


@st.composite
def transforms(draw, largest_angle=np.pi):
    angle = min(draw(angles), largest_angle)
    return geometry.compose(geometry.exp_so3(draw(units) * angle), draw(points))


@given(units, angles)
def test_exp_so3_is_a_rotation_that_keeps_its_axis(axis, angle):
    R = geometry.exp_so3(axis * angle)
    assert geometry.is_rigid(geometry.compose(R, np.zeros(3)))
    np.testing.assert_allclose(R @ axis, axis, atol=ROTATION_TOLERANCE)
    assert np.trace(R) == pytest.approx(1 + 2 * np.cos(angle), abs=ROTATION_TOLERANCE)


@given(units, angles)
def test_log_inverts_exp_of_a_rotation_up_to_the_sign_at_a_half_turn(axis, angle):
    R = geometry.exp_so3(axis * angle)
    rotation = geometry.log_so3(R)
    assert np.linalg.norm(rotation) <= np.pi + ROTATION_TOLERANCE
    np.testing.assert_allclose(geometry.exp_so3(rotation), R, atol=ROTATION_TOLERANCE)
    if angle < np.pi - HALF_TURN_TOLERANCE:
        np.testing.assert_allclose(rotation, axis * angle, atol=HALF_TURN_TOLERANCE)
    if angle < 3.0:
        np.testing.assert_allclose(rotation, axis * angle, atol=ROTATION_TOLERANCE)


@given(units, angles, points)
def test_exp_inverts_log_of_a_transform(axis, angle, t):
    T = geometry.compose(geometry.exp_so3(axis * angle), t)
    xi = geometry.log_se3(T)
    tolerance = TRANSLATION_TOLERANCE_MM if angle < 3.0 else HALF_TURN_TOLERANCE * 2000.0
    np.testing.assert_allclose(geometry.exp_se3(xi)[:3, 3], t, atol=tolerance)


@given(units, st.floats(1e-8, 1e-3), points)
def test_exp_se3_follows_its_power_series_at_small_angles(axis, angle, t):
    xi = np.concatenate([axis * angle, t])
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = geometry.skew(xi[:3]), xi[3:]
    series, term = np.eye(4), np.eye(4)
    for k in range(1, 8):
        term = term @ generator / k
        series += term
    np.testing.assert_allclose(geometry.exp_se3(xi), series, atol=1e-11)


@given(transforms(), units, st.floats(0.0, 3.0), points, points)
@example(np.eye(4), np.array([0.0, 0.0, 1.0]), 0.0, np.zeros(3), np.array([1.0, 2.0, 3.0]))
def test_difference_inverts_perturb(T_hat, axis, angle, t, p):
    xi = np.concatenate([axis * angle, t])
    T = geometry.perturb(T_hat, xi, p)
    np.testing.assert_allclose(geometry.difference(T, T_hat, p), xi, atol=1e-8)


@given(transforms(), points)
def test_a_rotation_about_the_covariance_point_leaves_it_in_place(T_hat, p):
    moved = geometry.perturb(T_hat, [0.1, -0.2, 0.3, 0, 0, 0], p)
    p_b = geometry.transform_points(geometry.invert(T_hat), p)
    np.testing.assert_allclose(geometry.transform_points(moved, p_b), p, atol=TRANSLATION_TOLERANCE_MM)


@given(transforms(), transforms(), points)
def test_transforms_compose_and_invert(T_a_b, T_b_c, x_c):
    x_a = geometry.transform_points(T_a_b, geometry.transform_points(T_b_c, x_c))
    np.testing.assert_allclose(geometry.transform_points(T_a_b @ T_b_c, x_c), x_a, atol=TRANSLATION_TOLERANCE_MM)
    np.testing.assert_allclose(geometry.invert(T_a_b) @ T_a_b, np.eye(4), atol=TRANSLATION_TOLERANCE_MM)


@given(transforms(), units, st.floats(0.0, 1.0), points)
def test_the_adjoint_moves_a_tangent_vector_through_a_transform(T, axis, angle, t):
    xi = np.concatenate([axis * angle, t / 1000.0])
    left = T @ geometry.exp_se3(xi) @ geometry.invert(T)
    np.testing.assert_allclose(geometry.exp_se3(geometry.adjoint(T) @ xi), left, atol=1e-8)


def test_move_covariance_agrees_with_samples():
    rng = np.random.default_rng(1)
    T_hat = geometry.exp_se3([0.3, -0.2, 2.0, 100.0, -50.0, 30.0])
    p, q = np.array([100.0, 20.0, 5.0]), np.array([-80.0, 60.0, 40.0])
    root = rng.normal(size=(6, 6)) * np.r_[np.full(3, 1e-5), np.full(3, 1e-3)][:, None]
    covariance = root @ root.T
    samples = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    moved = [geometry.difference(geometry.perturb(T_hat, xi, p), T_hat, q) for xi in samples]
    expected = geometry.move_covariance(covariance, p, q)
    # Whitened, the sample covariance of n samples scatters about the unit matrix by 1 / sqrt(n) = 0.016.
    white = np.linalg.solve(np.linalg.cholesky(expected), np.transpose(moved))
    np.testing.assert_allclose(white @ white.T / len(samples), np.eye(6), atol=5 / np.sqrt(len(samples)))


@given(points, points, points)
def test_move_covariance_there_and_back_changes_nothing(p, q, diagonal):
    covariance = np.diag(np.r_[1e-10, 2e-10, 3e-10, 1e-4 + diagonal**2 * 1e-9])
    back = geometry.move_covariance(geometry.move_covariance(covariance, p, q), q, p)
    np.testing.assert_allclose(back, covariance, atol=1e-12)


@given(transforms(), st.integers(3, 20), st.integers(0, 1000))
def test_fit_rigid_finds_the_transform_of_exact_points(T_a_b, count, seed):
    rng = np.random.default_rng(seed)
    b = rng.uniform(-300, 300, (count, 3)) * [1, 1, 0.01]  # nearly flat, where a reflection is nearest
    fitted = geometry.fit_rigid(geometry.transform_points(T_a_b, b), b, rng.uniform(0.1, 1, count))
    assert geometry.is_rigid(fitted)
    np.testing.assert_allclose(geometry.transform_points(fitted, b), geometry.transform_points(T_a_b, b), atol=1e-8)


@given(units, axes, points)
def test_plane_frame_has_its_axes_where_asked(z, hint, origin):
    if np.linalg.norm(np.cross(z, hint)) < 1e-2:
        return
    T = geometry.plane_frame(origin, 5 * z, hint)
    assert geometry.is_rigid(T)
    np.testing.assert_allclose(geometry.transform_points(T, origin), 0, atol=TRANSLATION_TOLERANCE_MM)
    np.testing.assert_allclose(T[2, :3], z, atol=ROTATION_TOLERANCE)
    assert T[0, :3] @ hint > 0


def test_transform_points_keeps_the_type_the_shape_and_nan():
    points_b = np.full((4, 5, 3), 2.0, np.float32)
    points_b[0, 0] = np.nan
    points_a = geometry.transform_points(geometry.translation([1, 2, 3]), points_b)
    assert points_a.dtype == np.float32
    assert np.isnan(points_a[0, 0]).all()
    np.testing.assert_array_equal(points_a[1, 1], [3, 4, 5])


def test_rotation_angle_reads_rotations_and_transforms():
    T = geometry.exp_se3([0, 0.5, 0, 1, 2, 3])
    assert geometry.rotation_angle(T) == pytest.approx(0.5)
    assert geometry.rotation_angle(T[:3, :3]) == pytest.approx(0.5)


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
PROJECTIVE = np.eye(4) + np.outer([0, 0, 0, 1], [0, 0, 1e-9, 0])


@pytest.mark.parametrize(
    "T",
    [MIRROR, PROJECTIVE, 1.001 * np.eye(4), np.eye(3), np.full((4, 4), np.nan), [[1, 2], [3]], "text", None],
    ids=["mirror", "projective", "scaled", "3 x 3", "nan", "ragged", "text", "none"],
)
def test_require_rigid_refuses_what_is_no_rigid_transform_and_names_it(T):
    with pytest.raises(InputError, match=r"cameras\.A\.T_camera_sensor") as caught:
        geometry.require_rigid(T, "cameras.A.T_camera_sensor")
    assert "4 x 4 rigid transform" in str(caught.value)


@given(transforms())
def test_require_rigid_accepts_transforms_written_with_seven_digits(T):
    rounded = np.round(T, 7)
    np.testing.assert_array_equal(geometry.require_rigid(rounded, "T"), rounded)
