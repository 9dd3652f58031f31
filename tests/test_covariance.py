"""The stated covariance of a refined pair against the scatter of repeated measurements; what nothing holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import sheets
from planish.geometry import difference
from planish.registration.pair import refine_pair
from planish.registration.prepared import prepare
from planish.registration.refine.covariance import _gradient_scatter, noise_covariance, observability
from planish.registration.refine.overlap import overlap_extent
from planish.registration.refine.sides import joint_sides
from planish.registration.refine.solve import RefineOptions, refine
from planish.registration.surface import fit_surface
from planish.registration.texture.photometric import PhotometricOptions, local_contrast
from planish.registration.tiles import tile_size_px
from planish.registration.verdict.geometry import Sight
from planish.registration.verdict.hypothesis import Drift
from planish.registration.verdict.judge import VerdictOptions, judge_refined

#: 14 runs of 6 parameters know a mean NEES to 15 %; interpolation at 1.3 mm per pixel adds a bias of one standard
#: deviation along the surface.
FAST_NEES_PER_DOF = (0.6, 1.6)
SLOW_NEES_PER_DOF = (0.8, 1.3)


def sides(m):
    """What the refinement needs of a measurement, without its keypoints."""
    surface, contrast = fit_surface(m), local_contrast(m)
    return joint_sides(m, surface, contrast, RefineOptions().spacing_px, PhotometricOptions().shading_mm)


def errors(seeds, factor=1.0):
    """Errors xi (n, 6) and stated covariances (n, 6, 6) of flat pairs with independent noise."""
    xi, C = [], []
    extent = overlap_extent(sheets.quiet("a", 0.0), sheets.quiet("b", 0.0), sheets.T_TRUE)
    tile = tile_size_px(sheets.quiet("b", 0.0))
    for seed in seeds:
        a, b = (sides(sheets.noisy(sheets.quiet(s, 0.0), 1000 + 2 * seed + i, factor)) for i, s in enumerate("ab"))
        found = refine(a, b, sheets.T_TRUE, *extent, tile)
        xi.append(difference(sheets.T_TRUE, found.T_a_b, found.about))
        C.append(noise_covariance(found))
    return np.array(xi), np.array(C)


def nees_per_dof(xi, C):
    return np.einsum("ni,ni->n", xi, np.linalg.solve(C, xi[..., None])[..., 0]) / 6


def test_the_stated_covariance_predicts_the_scatter():
    xi, C = errors(range(14))
    low, high = FAST_NEES_PER_DOF
    assert low < nees_per_dof(xi, C).mean() < high
    ratio = xi.std(0, ddof=1) / np.sqrt(np.diagonal(C, axis1=1, axis2=2).mean(0))
    # A standard deviation from 14 values is known to 20 %.
    assert ((ratio > 0.55) & (ratio < 1.5)).all()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_nees_over_200_seeds_is_one_per_degree_of_freedom(factor):
    xi, C = errors(range(200), factor)
    nees = nees_per_dof(xi, C)
    # The bias of the interpolation does not shrink with the noise: about the mean error, which is tested elsewhere.
    about_mean = nees_per_dof(xi - xi.mean(0), C)
    print(f"noise x {factor}: NEES / dof {nees.mean():.3f}, about the mean error {about_mean.mean():.3f}, ")
    print(f"95 % coverage about the mean {(6 * about_mean < chi2.ppf(0.95, 6)).mean():.3f}")
    assert SLOW_NEES_PER_DOF[0] < about_mean.mean() < SLOW_NEES_PER_DOF[1]


def test_twice_the_noise_gives_twice_the_sigma():
    # One pair's scatter of some hundred tiles knows a standard deviation to 7 %: the mean of three.
    C1, C2 = (errors([3, 4, 5], factor)[1].mean(0) for factor in (1.0, 2.0))
    ratio = np.sqrt(np.diag(C2) / np.diag(C1))
    # The texture's differences hold a part from interpolation that does not grow with the noise.
    np.testing.assert_allclose(ratio[[0, 1, 5]], 2, rtol=0.15)
    assert ((ratio > 1.3) & (ratio < 2.3)).all()


#: Gradients of a kind that no tile holds.
NONE = np.zeros((1, 1, 6))


def test_the_scatter_of_independent_tiles_is_their_sum_of_squares():
    rng = np.random.default_rng(0)
    distance, texture = rng.standard_normal((2, 60, 80, 6))
    # 9,600 tiles: a variance to 1.5 %; products with eight neighbours, of which only an excess counts, add as much.
    np.testing.assert_allclose(_gradient_scatter(distance, texture) / 4800, 2 * np.eye(6), atol=0.2)


def summed_neighbours(rng):
    """Gradients that share half of what they hold with neighbours."""
    white = rng.standard_normal((31, 41, 6))
    return white[1:, 1:] + white[:-1, 1:] + white[1:, :-1] + white[:-1, :-1]


def test_the_scatter_counts_what_neighbouring_tiles_share():
    rng = np.random.default_rng(0)
    sums, stated = [], []
    for _ in range(60):
        g = summed_neighbours(rng)
        sums.append(g.sum((0, 1)))
        stated.append(np.diag(_gradient_scatter(g, NONE)))
    # A variance from 360 values is known to 7 %.
    assert np.mean(stated) == pytest.approx(np.mean(np.square(sums)), rel=0.2)


def test_what_neighbours_share_of_one_kind_does_not_widen_the_other():
    rng = np.random.default_rng(0)
    texture = summed_neighbours(rng) * [1, 1, 1, 0, 0, 0]
    distance = rng.standard_normal(texture.shape) * [0, 0, 0, 1, 1, 1]
    tiles = texture[..., 0].size
    of_texture, of_distance = np.split(np.diag(_gradient_scatter(distance, texture)) / tiles, 2)
    # Four values of unit variance in each, four times as much in their sum; 1,200 tiles: a variance to a few percent.
    np.testing.assert_allclose(of_texture, 16, rtol=0.3)
    np.testing.assert_allclose(of_distance, 1, rtol=0.15)


def test_empty_tiles_do_not_count():
    g = np.random.default_rng(0).standard_normal((9, 9, 6))
    padded = np.zeros((30, 20, 6))
    padded[5:14, 3:12] = g
    np.testing.assert_allclose(_gradient_scatter(padded, NONE), _gradient_scatter(g, NONE), rtol=1e-9)
    assert not _gradient_scatter(NONE, NONE).any()


@pytest.fixture(scope="module")
def refined():
    return refine_pair(*sheets.pair(), sheets.T_TRUE)


def test_a_textured_bent_sheet_is_held_in_all_directions(refined):
    C = noise_covariance(refined)
    directions = observability(refined, C)
    assert all(d.observable for d in directions)
    axes = np.array([d.direction for d in directions])
    np.testing.assert_allclose(axes @ axes.T, np.eye(6), atol=1e-9)
    assert np.linalg.eigvalsh(C).min() > 0
    np.testing.assert_allclose(C, C.T, rtol=1e-9, atol=1e-18)


def test_geometry_holds_the_normal_and_texture_the_plate():
    found = refine_pair(*sheets.pair(bend=0.0), sheets.T_TRUE)
    for d in observability(found, noise_covariance(found)):
        along_plate = np.linalg.norm([d.direction[2], *d.direction[3:5]])
        assert (along_plate > 0.99) != (along_plate < 0.1)
        assert d.texture_share > 0.95 if along_plate > 0.5 else d.texture_share < 0.05


def test_a_plate_without_texture_leaves_three_directions_loose():
    a, b = (prepare(sheets.noisy(sheets.quiet(s, 0.0, 0.0), 5 + i), sheets.PITCH_MM) for i, s in enumerate("ab"))
    found = refine_pair(a, b, sheets.T_TRUE)
    directions = observability(found, noise_covariance(found))
    held = [d for d in directions if np.linalg.norm([d.direction[2], *d.direction[3:5]]) < 0.1]
    loose = [d for d in directions if np.linalg.norm([d.direction[2], *d.direction[3:5]]) > 0.9]
    assert len(held) == len(loose) == 3
    assert max(d.sigma_mm for d in held) < 0.01
    assert min(d.sigma_mm for d in loose) > 0.2
    assert judge_refined(found, directions, Drift(0.1), Sight(1000, 0), VerdictOptions()).status == "refused"


def test_without_texture_geometry_alone_leaves_the_plate_loose():
    found = refine_pair(*sheets.pair(bend=0.0), sheets.T_TRUE)
    e = found.equations
    blind = replace(found, equations=replace(e, H_texture_unbiased=np.zeros((6, 6))))
    C = noise_covariance(blind)
    assert np.isfinite(C).all()
    assert [d.observable for d in observability(blind, C)] == [True] * 3 + [False] * 3
