"""Gain, offset and slow shading between two textures belong to the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sheets
from planish.geometry import difference, perturb
from planish.registration.pair import refine_pair
from planish.registration.prepared import RefinementMaps
from planish.registration.refine.covariance import noise_covariance
from planish.registration.refine.residuals import Weights, equations
from planish.registration.refine.shading import shading, without_shading
from planish.registration.refine.sides import JointSide

#: Sums of float32 against float64, relative to the largest.
SUM_TOLERANCE = 1e-4
#: Another lamp: contrasts that differ by half, more on one side than on the other.
GAINS = (1.0, 0.4)
#: The mean of both textures, against which a gain is measured, holds noise: the slope falls short by its share.
LEAST_SLOPE = 0.7
TILE = 8


@pytest.fixture(scope="module")
def bent():
    return sheets.pair()


def look(a: JointSide, b: JointSide, weights: Weights, T=sheets.T_TRUE, residuals=False):
    return equations(
        a, b, T, np.zeros(3), weights, max_distance_mm=3.0, max_normal_rad=0.35, stride=1, tile_px=TILE,
        residuals=residuals, threads=2,
    )  # fmt: skip


def dimmed(side: JointSide) -> JointSide:
    """The texture with less contrast to the right, its noise included: light that the texture does not reflect."""
    gain = np.linspace(*GAINS, side.texture.shape[1], dtype=np.float32)
    values = side.values.copy()
    values[..., 8:11] *= gain[:, None]
    values[..., 7] *= gain**2
    return replace(side, texture=side.texture * gain, values=values)


def in_another_light(prepared):
    sides = {n: dimmed(side) for n, side in prepared.sides.items()}
    return replace(prepared, refinement=RefinementMaps(lambda: (sides, prepared.fit_sides)))


def test_the_sums_are_the_derivatives_of_the_gradient_by_gain_and_offset(bent):
    """Central differences of the cost's gradient and of its own sums, all weights alike: both are linear in them."""
    a, b = (side.fit_sides[2] for side in bent)
    plain = Weights.alike(b, TILE)
    found = look(a, b, plain).tile_shading.sum((0, 1))
    change, square = found[:12].reshape(2, 6), found[12:16].reshape(2, 2)
    for k, step in enumerate(np.diag([1e-3, 1e-4]).astype(np.float32)):
        ends = [look(a, b, plain.shaded(sign * step)) for sign in (1, -1)]
        slope = (ends[0].tile_shading - ends[1].tile_shading).sum((0, 1))[16:] / (2 * step[k])
        np.testing.assert_allclose(-slope, square[k], rtol=1e-3, atol=1e-3 * np.abs(square).max())
    # The Jacobian holds the gain, too: the gradient by the offset alone is linear.
    np.testing.assert_allclose(
        -(ends[0].g_texture - ends[1].g_texture) / (2 * step[1]), change[1], rtol=1e-3, atol=1e-3 * np.abs(change).max()
    )


def test_eliminating_them_is_solving_for_all_parameters_at_once(bent):
    a, b = (side.fit_sides[2] for side in bent)
    found = look(a, b, Weights.alike(b, TILE))
    rows, columns = found.tile_shading.shape[:2]
    cells = [(i, j) for i in range(0, rows, 3) for j in range(0, columns, 3)]
    sums = np.array([found.tile_shading[i : i + 3, j : j + 3].sum((0, 1)) for i, j in cells])
    sums = sums[np.linalg.det(sums[:, 12:16].reshape(-1, 2, 2)) > 0]
    n = 6 + 2 * len(sums)
    H, g = np.zeros((n, n)), np.concatenate([found.g_texture, sums[:, 16:].ravel()])
    H[:6, :6] = found.H_texture
    for k, s in enumerate(sums):
        at = slice(6 + 2 * k, 8 + 2 * k)
        H[:6, at] = s[:12].reshape(2, 6).T
        H[at, :6] = H[:6, at].T
        H[at, at] = s[12:16].reshape(2, 2)
    free = without_shading(found)
    scale = np.sqrt(np.diag(H))
    every = np.linalg.solve(H / np.outer(scale, scale), g / scale)[:6] / scale[:6]
    np.testing.assert_allclose(np.linalg.solve(free.H_texture, free.g_texture), every, rtol=1e-6)
    np.testing.assert_allclose(free.tile_gradients[:, :, 1].sum((0, 1)), free.g_texture, rtol=1e-9)
    lost = np.linalg.eigvalsh((found.H_texture - free.H_texture) / np.outer(scale[:6], scale[:6]))
    assert lost.min() > -1e-9


def test_a_contrast_that_changes_over_the_surface_is_found(bent):
    a, b = bent[0].fit_sides[1], dimmed(bent[1].sides[1])
    found = look(a, b, Weights.alike(b, TILE))
    gain = shading(found.sums)[:, :, 0]
    middle = (np.arange(gain.shape[1]) + 0.5) * TILE / b.texture.shape[1]
    expected = np.interp(middle, (0, 1), GAINS)
    known = found.tile_sizes[:, :, 1, 0] > TILE**2 / 2
    # r = (1 - g / 2) a - (1 + g / 2) b vanishes for b = a (1 - g / 2) / (1 + g / 2).
    true = np.broadcast_to(2 * (1 - expected) / (1 + expected), gain.shape)[known]
    slope, _ = np.polyfit(true, gain[known], 1)
    assert LEAST_SLOPE < slope <= 1
    assert np.corrcoef(true, gain[known])[0, 1] > 0.95


def test_another_light_changes_neither_the_transform_nor_its_covariance(bent):
    start = perturb(sheets.T_TRUE, [0, 0, 0, 0.4, -0.3, 0.2], [30, 10, 0])
    plain, other = refine_pair(*bent, start), refine_pair(bent[0], in_another_light(bent[1]), start)
    C = noise_covariance(plain)
    xi = difference(plain.T_a_b, other.T_a_b, plain.about)
    # The same noise, weighted a little differently: less than half a standard deviation in each direction.
    assert xi @ np.linalg.solve(C, xi) < 6 / 4
    ratio = np.linalg.eigvals(np.linalg.solve(C, noise_covariance(other))).real
    assert (ratio > 0.6).all()
    assert (ratio < 1.6).all()
