"""The joint refinement: residuals and Jacobians, convergence, symmetry, threads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import sheets
from planish.geometry import difference, exp_se3, invert, perturb
from planish.registration.pair import refine_pair
from planish.registration.prepared import prepare
from planish.registration.refine.covariance import noise_covariance
from planish.registration.refine.information import information
from planish.registration.refine.overlap import overlap_extent
from planish.registration.refine.residuals import Weights, equations
from planish.registration.refine.sides import joint_sides, thinned_texture
from planish.registration.refine.solve import RefineOptions, refine
from planish.registration.surface import fit_surface
from planish.registration.texture.photometric import PhotometricOptions, local_contrast
from planish.rig import Rig
from reference import joint as reference

#: float32 look-up weights and maps against float64.
RESIDUAL_TOLERANCE = 2e-4
#: Sums over 50,000 pixels of such residuals, relative to the largest element.
SUM_TOLERANCE = 1e-4
#: On planes the distance is linear in xi: what is left is the rounding of float32 points over the step.
DISTANCE_JACOBIAN_TOLERANCE = 1e-3
#: The texture's Jacobian is the mean of both sides' gradients, 0.1 mm apart here in a texture smoothed by 6.5 mm; the
#: look-up's own derivative is that of one side. Central differences and linear look-up keep 98 % of such a gradient.
TEXTURE_JACOBIAN_TOLERANCE = 0.04
#: 1 mm and 0.3 degrees off, about the centre of the overlap.
START = np.array([0.004, -0.003, 0.002, 0.6, -0.7, 0.4])
#: A start beyond the first level's distance of 3 mm along the normal, and turned by 0.3 degrees [mm, rad].
FAR_MM, FAR_TURN = 3.2, (0.003, 0.004, 0.0)
#: float32 points carry 6e-5 mm; other sensor coordinates round them otherwise, 50,000 of them average it.
FRAME_TOLERANCE_MM = 1e-3
LEVER_MM = 150.0
SCALE = np.array([LEVER_MM] * 3 + [1.0] * 3)


def at(a, b, T, about, weights=None, **changes):
    settings = {
        "max_distance_mm": 3.0,
        "max_normal_rad": 0.35,
        "stride": 1,
        "tile_px": 8,
        "residuals": False,
        "threads": 2,
    }
    return equations(a, b, T, about, weights, **{**settings, **changes})


@pytest.fixture(scope="module")
def bent():
    return sheets.pair()


def clean_sides(bend):
    a, b = (prepare(sheets.quiet(side, bend), sheets.PITCH_MM).sides[1] for side in "ab")
    inner = np.zeros(b.texture.shape, np.uint8)
    # Far from the rim of either image, so that a small motion leaves every pixel in.
    inner[40:-40, 80:-100] = 1
    return a, replace(b, use=inner)


@pytest.mark.parametrize(("gain", "offset"), [(0.0, 0.0), (0.4, 0.003)])
def test_residuals_and_normal_equations_are_those_of_the_definition(bent, gain, offset):
    a, b = (side.fit_sides[1] for side in bent)
    camera = bent[0].measurement.camera
    about = np.array([30.0, 10.0, -5.0])
    T = perturb(sheets.T_TRUE, [1e-4, 2e-4, -1e-4, 0.1, 0.05, 0.02], about)
    scale, weight_d, weight_t = 1.5, 0.7, 0.8
    weights = Weights.alike(b, 8, weight_d, weight_t, scale).shaded(np.array([gain, offset], np.float32))
    found = at(a, b, T, about, weights, residuals=True)
    rows, columns, d, of_distance, t, of_texture = reference.residuals(
        a.maps, camera, b.maps, T, about, 3.0, np.cos(0.35), gain, offset
    )
    assert found.points == len(d)
    assert found.points == np.isfinite(found.distances).sum()
    np.testing.assert_allclose(found.distances[rows, columns], d, atol=RESIDUAL_TOLERANCE)
    np.testing.assert_allclose(found.differences[rows, columns], t, atol=RESIDUAL_TOLERANCE)
    known = np.isfinite(t)
    assert found.texture_points == known.sum()
    np.testing.assert_allclose(found.tile_sizes.sum((0, 1))[:, 0], [len(d), known.sum()])
    np.testing.assert_allclose(
        found.tile_sizes.sum((0, 1))[:, 1], [np.abs(d).sum(), np.abs(t[known]).sum()], rtol=SUM_TOLERANCE
    )
    cost = 0.0
    for r, jacobians, weight, H, g, unbiased, slope in (
        (d, of_distance, weight_d, found.H_distance, found.g_distance, found.H_distance_unbiased, found.slope_distance),
        (
            t[known], [J[known] for J in of_texture], weight_t, found.H_texture, found.g_texture,
            found.H_texture_unbiased, found.slope_texture,
        ),
    ):  # fmt: skip
        J, J_a, J_b = jacobians
        w = weight * reference.tukey(r, scale)
        close(H, (J * w[:, None]).T @ J)
        close(g, J.T @ (w * r))
        cross = (J_a * w[:, None]).T @ J_b
        close(unbiased, (cross + cross.T) / 2)
        step = 1e-5
        influence = [x * reference.tukey(x, scale) for x in (r + step * scale, r - step * scale)]
        derivative = (influence[0] - influence[1]) / (2 * step * scale)
        assert slope == pytest.approx(weight * derivative.sum() / w.sum(), rel=1e-3)
        cost += w @ r**2
    assert found.cost == pytest.approx(cost, rel=1e-3)


def close(found, expected):
    """Compare in units in which rotations move the rim as much as translations."""
    scale = np.outer(SCALE, SCALE) if np.ndim(found) == 2 else SCALE
    np.testing.assert_allclose(found / scale, expected / scale, atol=SUM_TOLERANCE * np.abs(expected / scale).max())


def test_the_gradients_of_the_tiles_add_up_to_the_whole(bent):
    a, b = (side.fit_sides[2] for side in bent)
    found = at(a, b, sheets.T_TRUE, np.zeros(3), Weights.alike(b, 8, 0.7, 0.8, 1.5))
    np.testing.assert_allclose(found.tile_gradients.sum((0, 1)), [found.g_distance, found.g_texture], rtol=1e-9)


def test_held_out_pixels_take_no_part(bent):
    a, b = bent
    everything = at(a.sides[1], b.sides[1], sheets.T_TRUE, np.zeros(3))
    fitted = at(a.fit_sides[1], b.sides[1], sheets.T_TRUE, np.zeros(3))
    assert fitted.points / everything.points == pytest.approx(0.8, abs=0.03)


def jacobian(a, b, T, about, name, step):
    """Central differences (n, 6) of a residual map, scaled to the rim, and the residuals (n,) at T."""
    columns = []
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = step / SCALE[k]
        ends = [getattr(at(a, b, perturb(T, sign * xi, about), about, residuals=True), name) for sign in (1, -1)]
        columns.append((ends[0].astype(float) - ends[1]) / (2 * step))
    J = np.stack(columns, -1)
    r = getattr(at(a, b, T, about, residuals=True), name).astype(float)
    known = np.isfinite(J).all(2) & np.isfinite(r)
    assert known.sum() > 0.98 * (b.use != 0).sum()
    return J[known], r[known]


@pytest.mark.parametrize("bend", [0.0, sheets.BENT])
def test_the_jacobian_of_the_distance_is_its_derivative(bend):
    a, b = clean_sides(bend)
    about = np.array([30.0, 10.0, 0.0])
    # Along the normal and along the surface: both normals stay parallel.
    T = perturb(sheets.T_TRUE, [0, 0, 0.0005, 0.05, 0.03, 0.4], about)
    J, r = jacobian(a, b, T, about, "distances", 0.5)
    found = at(a, b, T, about)
    agree(found.H_distance, found.g_distance, J, r, DISTANCE_JACOBIAN_TOLERANCE)


def smooth_side(m):
    """A measurement whose texture is smoothed by 5 px."""
    surface, (value, sigma) = fit_surface(m), local_contrast(m)
    side = joint_sides(m, surface, (value, sigma), (1,), PhotometricOptions().shading_mm)[1]
    smooth, _ = thinned_texture(value, np.isfinite(value), 5.0, 1)
    values = side.values.copy()
    values[..., 7] = sigma**2
    values[..., 8:11] = sheets.texture_gradient(smooth, surface)
    return replace(side, values=values, texture=smooth)


def test_the_jacobian_of_the_texture_is_its_derivative():
    """One measurement against itself a little off, moved in its plane: the look-up follows the surface exactly."""
    # Smooth enough that central differences and interpolation see the same slopes.
    a = smooth_side(sheets.quiet("a", 0.0))
    inner = np.zeros(a.texture.shape, np.uint8)
    inner[20:-20, 20:-20] = 1
    b = replace(a, use=inner)
    about = np.array([10.0, 10.0, 0.0])
    T = perturb(np.eye(4), [0, 0, 0.001, 0.1, -0.05, 0], about)
    J, r = jacobian(a, b, T, about, "differences", 0.1)
    found, in_plane = at(a, b, T, about), (2, 3, 4)
    for H in (found.H_texture, found.H_texture_unbiased):
        agree(H, found.g_texture, J, r, TEXTURE_JACOBIAN_TOLERANCE, in_plane)


def agree(H, g, J, r, tolerance, motions=range(6)):
    motions = list(motions)
    chosen = np.ix_(motions, motions)
    H_expected, g_expected = J.T @ J, J.T @ r
    limit = tolerance * np.abs(H_expected[chosen]).max()
    np.testing.assert_allclose((H / np.outer(SCALE, SCALE))[chosen], H_expected[chosen], atol=limit)
    limit = tolerance * np.abs(g_expected[motions]).max()
    np.testing.assert_allclose((g / SCALE)[motions], g_expected[motions], atol=limit)


def test_noise_of_the_normals_inflates_only_the_plain_information():
    """A noisy plane says nothing about motions along itself."""
    a, b = (prepare(sheets.noisy(sheets.quiet("a", 0.0), seed), sheets.PITCH_MM).sides[1] for seed in (1, 2))
    found = at(a, b, np.eye(4), np.zeros(3))
    assert abs(found.H_distance_unbiased[3, 3]) < 0.1 * found.H_distance[3, 3]
    assert found.H_distance_unbiased[5, 5] == pytest.approx(found.H_distance[5, 5], rel=1e-4)


def test_the_gradient_noise_inflates_only_the_plain_information():
    """Two exposures of the same view with pure noise as texture: no information about motions along the plane."""
    a, b = (prepare(sheets.noisy(sheets.quiet("a", 0.0, 0.0), seed), sheets.PITCH_MM).sides[1] for seed in (1, 2))
    found = at(a, b, np.eye(4), np.zeros(3))
    plain, unbiased = found.H_texture[3, 3], found.H_texture_unbiased[3, 3]
    assert abs(unbiased) < 0.05 * plain


@pytest.mark.parametrize("sign", [1, -1])
def test_a_start_one_millimetre_off_leads_to_the_truth(bent, sign):
    found = refine_pair(*bent, perturb(sheets.T_TRUE, sign * START, [30, 10, 0]))
    assert found.converged
    xi = difference(sheets.T_TRUE, found.T_a_b, found.about)
    # 22.5: the 99.9 % point of chi squared with six degrees of freedom.
    assert xi @ np.linalg.solve(noise_covariance(found), xi) < 22.5
    assert np.linalg.norm(xi[3:]) < 0.03


def test_a_start_farther_off_along_the_normal_than_the_first_distance_leads_to_the_truth(bent):
    normal = sheets.T_TRUE[:3, 2] * FAR_MM
    found = refine_pair(*bent, perturb(sheets.T_TRUE, [*FAR_TURN, *normal], [30, 10, 0]))
    assert found.converged
    xi = difference(sheets.T_TRUE, found.T_a_b, found.about)
    assert xi @ np.linalg.solve(noise_covariance(found), xi) < 22.5


def test_only_the_first_level_of_a_start_from_afar_sees_farther():
    options = RefineOptions()
    turned = options.start_turn_rad * LEVER_MM
    assert options.first_gate_mm(LEVER_MM) == pytest.approx(options.max_distance_mm[0] + np.sqrt(3) * turned)
    near = options.starting_within(1.0, 0.33)
    assert near.first_gate_mm(LEVER_MM) == near.max_distance_mm[0] < options.max_distance_mm[0]


def test_the_result_does_not_depend_on_the_start(bent):
    starts = (sheets.T_TRUE, perturb(sheets.T_TRUE, START, [30, 10, 0]))
    first, second = (refine_pair(*bent, T) for T in starts)
    xi = difference(first.T_a_b, second.T_a_b, first.about)
    # A level ends when a step is below step_mm.
    assert np.linalg.norm(xi[3:]) + LEVER_MM * np.linalg.norm(xi[:3]) < 2 * RefineOptions().step_mm


def test_forward_is_the_inverse_of_backward():
    # On a flat sheet: on a bent one the look-up's chords between pixels of 1.3 mm shift the normal by 0.3 micrometres,
    # more than its standard deviation.
    a, b = sheets.pair(bend=0.0)
    forward, backward = refine_pair(a, b, sheets.T_TRUE), refine_pair(b, a, invert(sheets.T_TRUE))
    xi = difference(invert(backward.T_a_b), forward.T_a_b, forward.about)
    # Both see the same noise, so that they differ by less than one standard deviation per parameter.
    assert xi @ np.linalg.solve(noise_covariance(forward), xi) < 6


@pytest.mark.parametrize("which", [0, 1])
def test_another_sensor_frame_gives_the_same_answer(bent, which):
    G = exp_se3([0.4, -0.7, 1.1, 120, -80, 300])
    sides = list(bent)
    m = sides[which].measurement
    camera = replace(m.camera, T_camera_sensor=m.camera.T_camera_sensor @ invert(G))
    points = (m.points_sensor.astype(float) @ G[:3, :3].T + G[:3, 3]).astype(np.float32)
    sides[which] = prepare(replace(m, rig=Rig({"A": camera}), points_sensor=points), sheets.PITCH_MM)
    start = perturb(sheets.T_TRUE, START, [30, 10, 0])
    moved = refine_pair(*sides, G @ start if which == 0 else start @ invert(G))
    plain = refine_pair(*bent, start)
    T = invert(G) @ moved.T_a_b if which == 0 else moved.T_a_b @ G
    xi = difference(plain.T_a_b, T, plain.about)
    assert np.linalg.norm(xi[3:]) < FRAME_TOLERANCE_MM
    assert np.linalg.norm(xi[:3]) * LEVER_MM < FRAME_TOLERANCE_MM


def test_the_refinement_is_the_same_for_any_number_of_threads(bent):
    start = perturb(sheets.T_TRUE, START, [30, 10, 0])
    results = [refine_pair(*bent, start, threads=threads) for threads in (1, 2, 8)]
    assert len({r.T_a_b.tobytes() + noise_covariance(r).tobytes() for r in results}) == 1


def test_surfaces_apart_cannot_be_refined(bent):
    a, b = bent
    far = sheets.T_TRUE @ exp_se3([0, 0, 0, 900, 0, 0])
    assert overlap_extent(a.measurement, b.measurement, far) is None
    assert refine_pair(a, b, far) is None
    assert refine(a.fit_sides, b.sides, far, np.zeros(3), LEVER_MM, 8) is None


def test_the_extent_of_the_overlap_is_its_centre_and_radius():
    m = sheets.quiet("a", 0.0)
    centre, radius = overlap_extent(m, m, np.eye(4))
    points = m.points_sensor.reshape(-1, 3).astype(float)
    # Every eighth pixel stands for all: half of that along the rim.
    np.testing.assert_allclose(centre, points.mean(0), atol=6 * sheets.GSD_MM)
    assert radius == pytest.approx(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()), rel=0.03)


def test_smoothing_averages_known_pixels_only():
    value = np.full((40, 50), 3.0, np.float32)
    known = np.ones(value.shape, bool)
    known[10:20, 10:20] = False
    value[~known] = 1e6
    smooth, slopes = thinned_texture(value, known, 2.0, 1)
    assert np.isnan(smooth[~known]).all()
    np.testing.assert_allclose(smooth[known], 3.0, rtol=1e-6)
    np.testing.assert_allclose(slopes[known], 0.0, atol=1e-6)


def test_every_nth_pixel_is_that_of_the_whole_resolution_and_its_slope_the_derivative():
    rng = np.random.default_rng(1)
    value = rng.standard_normal((83, 70)).astype(np.float32)
    known = rng.random(value.shape) < 0.9
    whole, _ = thinned_texture(value, known, 4.8, 1, 2)
    thinned, slopes = thinned_texture(value, known, 4.8, 8, 2)
    np.testing.assert_array_equal(thinned, whole[::8, ::8])
    mean = gaussian_filter(np.where(known, value, 0).astype(float), 4.8, mode="constant") / gaussian_filter(
        known.astype(float), 4.8, mode="constant"
    )
    inner = known[8:-8:8, 8:-8:8]
    for axis, found in ((1, slopes[..., 0]), (0, slopes[..., 1])):
        expected = np.gradient(mean, axis=axis)[::8, ::8]
        # Differences of neighbours fall short by (1 / 4.8)^2 / 6.
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found[1:-1, 1:-1][inner], expected[1:-1, 1:-1][inner], atol=0.02 * scale)


def test_distances_pull_nowhere_along_a_noisy_plane():
    """The noise of the normals has a gradient along the plane; its share of the information says that it is noise."""
    a, b = (prepare(sheets.noisy(sheets.quiet("a", 0.0), seed), sheets.PITCH_MM).sides[1] for seed in (1, 2))
    about = np.zeros(3)
    plain = at(a, b, np.eye(4), about)
    found = at(a, b, np.eye(4), about, Weights.from_residuals(plain.sums, 1.0))
    info = information(found, LEVER_MM)
    held = found.g_distance / SCALE
    along, across = [2, 3, 4], [0, 1, 5]
    kept = info.trust @ held
    # In units of the noise of the gradient along the plane if normals and distances were independent.
    expected = np.sqrt(np.diag(found.H_distance)[along]) / SCALE[along]
    assert (np.abs(held[along]) > 0.1 * expected).any()
    assert (np.abs(kept[along]) < 0.1 * expected).all()
    np.testing.assert_allclose(kept[across], held[across], rtol=0.02, atol=0.02 * np.abs(held[across]).max())


def test_the_curvature_of_weak_texture_is_that_of_its_gradient():
    """Grain at half of its noise: steps by J'J would fall short, the expected curvature predicts the gradient."""
    # Two views, so that the pixels of one lie anywhere between those of the other.
    a, b = (
        prepare(sheets.noisy(sheets.quiet(s, 0.0, 0.02), i, 4.0), sheets.PITCH_MM).sides[1] for i, s in enumerate("ab")
    )
    about = np.zeros(3)
    weights = Weights.from_residuals(at(a, b, sheets.T_TRUE, about).sums, a.noise_passed)
    xi = np.array([0, 0, 0, 0.2, 0, 0])
    ends = [at(a, b, perturb(sheets.T_TRUE, s * xi, about), about, weights) for s in (1, -1)]
    slope = (ends[0].g_texture - ends[1].g_texture)[3] / 0.4
    middle = at(a, b, sheets.T_TRUE, about, weights)
    assert middle.H_texture[3, 3] > 1.5 * slope
    info = information(middle, LEVER_MM)
    # Two noisy gradients over 50,000 pixels.
    assert info.texture[3, 3] == pytest.approx(slope, rel=0.15)
