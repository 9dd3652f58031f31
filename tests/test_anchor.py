"""The anchor: windows of weak textures hold a refined transform where single pixels do not."""

from __future__ import annotations

import numpy as np
import pytest

from planish.geometry import difference, exp_se3, perturb, transform_points
from planish.registration.refine.anchor import Anchor
from planish.registration.verdict.hypothesis import Hypothesis
from planish.registration.verdict.together import Together
from planish.registration.verdict.verify import Windows

ABOUT = np.array([10.0, -20.0, 5.0])
POINTS = np.random.default_rng(3).uniform(-80, 80, (40, 3))
SIGMA_MM, AGREE_MM = 0.3, 1.0
T_TRUE = exp_se3([0.3, -0.1, 0.8, 5, 6, 7])


def cost(xi):
    """Half of the squared shifts of the windows in units of their deviation; shared with the pixels: half of that."""
    shift = transform_points(perturb(np.eye(4), xi, ABOUT), POINTS) - POINTS
    return 0.5 * (shift**2).sum() / (2 * SIGMA_MM**2)


def test_the_information_is_that_of_the_windows_shifts():
    steps = 1e-3 * np.eye(6)
    found = Anchor(T_TRUE, POINTS, SIGMA_MM).information(ABOUT)
    numeric = [
        [(cost(p + q) - cost(p - q) - cost(q - p) + cost(-p - q)) / 4e-6 for q in steps] for p in steps
    ]  # fmt: skip
    # Second order in rotations of 1e-3 rad.
    np.testing.assert_allclose(found, numeric, rtol=1e-3, atol=1e-4 * np.abs(found).max())


def test_the_mean_has_the_errors_that_its_covariance_says():
    rng = np.random.default_rng(5)
    loose = np.diag([1e-4, 2e-4, 1e-4, 0.02, 0.3, 0.01]) ** 2
    anchor = Anchor(T_TRUE, POINTS, SIGMA_MM)
    own = np.linalg.inv(anchor.information(ABOUT))
    squares = []
    for _ in range(300):
        T = perturb(T_TRUE, rng.multivariate_normal(np.zeros(6), loose), ABOUT)
        held = Anchor(perturb(T_TRUE, rng.multivariate_normal(np.zeros(6), own), ABOUT), POINTS, SIGMA_MM)
        mean, C = held.combined(T, loose, ABOUT)
        xi = difference(T_TRUE, mean, ABOUT)
        squares.append(xi @ np.linalg.solve(C, xi))
        assert np.trace(C[3:, 3:]) < min(np.trace(loose[3:, 3:]), np.trace(own[3:, 3:]))
    # 300 chi-squared values of six degrees: four standard deviations of their mean.
    assert np.mean(squares) == pytest.approx(6, abs=4 * np.sqrt(12 / 300))


@pytest.mark.parametrize(("sigma_mm", "shift_mm"), [(1e-6, 0.0), (1e3, 0.3)])
def test_a_strong_anchor_keeps_its_transform_and_a_weak_one_lets_go(sigma_mm, shift_mm):
    refined = perturb(T_TRUE, [0, 0, 0, 0.3, 0, 0], ABOUT)
    T, _ = Anchor(T_TRUE, POINTS, sigma_mm).combined(refined, np.diag([1e-4] * 3 + [0.02] * 3) ** 2, ABOUT)
    assert difference(T, T_TRUE, ABOUT)[3] == pytest.approx(shift_mm, abs=1e-4)


def hypothesis(offsets_mm, others=0, chance=0.05):
    """A motion whose agreeing windows have these offsets, and others that do not agree."""
    n = len(offsets_mm) + others
    offsets = np.vstack([offsets_mm, np.full((others, 2), 3.0)])
    none, pixels, heights = np.zeros(n), np.zeros((n, 2)), np.zeros((n, 1), np.float32)
    agrees, together = np.arange(n) < len(offsets_mm), Together(heights, heights, np.ones(1, bool))
    cells, points = np.arange(n), np.zeros((n, 3))
    windows = Windows(cells, points, pixels, pixels, pixels, offsets, none, agrees, chance, none, together)
    return Hypothesis(T_TRUE, np.empty(0, np.int64), 0, np.empty((0, 3)), windows, -10.0, -10.0, 50.0)


class TestScatter:
    rng = np.random.default_rng(1)

    def peaks(self, *sigmas_mm, count=4000):
        """Gaussian peaks as far as they lie within the gate."""
        drawn = self.rng.normal(0, sigmas_mm, (count, 2))
        return drawn[np.hypot(*drawn.T) <= AGREE_MM]

    def test_the_direction_of_the_most_scatter_speaks_for_all(self):
        found = hypothesis(self.peaks(0.05, 0.2)).anchor(AGREE_MM)
        # The gate narrows 0.2 mm by a little, which is taken into account to a tenth.
        assert found.sigma_mm == pytest.approx(0.2, rel=0.1)

    def test_peaks_that_stand_anywhere_along_the_grain_hold_nothing(self):
        assert hypothesis(self.peaks(0.05, 30.0, count=40000)[:2000]).anchor(AGREE_MM) is None

    def test_peaks_as_many_as_by_chance_hold_nothing(self):
        assert hypothesis(self.peaks(0.1, 0.1)[:20], others=380).anchor(AGREE_MM) is None

    @pytest.mark.parametrize("share", [0.4, 0.7, 0.95, 1.0])
    def test_windows_without_texture_neither_widen_nor_narrow_the_scatter_of_the_others(self, share):
        sigma_mm, chance, count = 0.15, 0.05, 4000
        told = self.peaks(sigma_mm, sigma_mm, count=round(share * count))
        # The others' peaks stand anywhere in the search area, of which the gate is a share.
        radius = AGREE_MM / np.sqrt(chance) * np.sqrt(self.rng.uniform(0, 1, count - len(told)))
        angle = self.rng.uniform(0, 2 * np.pi, len(radius))
        anywhere = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        agreeing = anywhere[radius <= AGREE_MM]
        found = hypothesis(np.vstack([told, agreeing]), len(anywhere) - len(agreeing), chance).anchor(AGREE_MM)
        # Those that agree by chance count as windows, and hold nothing.
        worth = sigma_mm / np.sqrt(len(told) / (len(told) + len(agreeing)))
        assert found.sigma_mm == pytest.approx(worth, rel=0.1)
