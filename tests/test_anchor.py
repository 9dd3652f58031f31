"""The anchor: windows of weak textures hold the refinement where single pixels do not."""

from __future__ import annotations

import numpy as np
import pytest

import sheets
from planish.geometry import exp_se3, perturb, transform_points
from planish.registration.pair import refine_pair
from planish.registration.refine.anchor import Anchor

ABOUT = np.array([10.0, -20.0, 5.0])
POINTS = np.random.default_rng(3).uniform(-80, 80, (40, 3))
SIGMA_MM = 0.3


@pytest.fixture(scope="module")
def equations():
    return refine_pair(*sheets.pair(), sheets.T_TRUE).equations


def cost(xi):
    """Half of the squared shifts of the windows in units of their deviation; shared with the pixels: half of that."""
    shift = transform_points(perturb(np.eye(4), xi, ABOUT), POINTS) - POINTS
    return 0.5 * (shift**2).sum() / (2 * SIGMA_MM**2)


def test_gradient_and_curvature_are_those_of_the_windows_shifts(equations):
    T = exp_se3([0.3, -0.1, 0.8, 5, 6, 7])
    xi = np.array([2e-4, -1e-4, 3e-4, 0.02, -0.01, 0.03])
    held = Anchor(T, POINTS, SIGMA_MM).hold(equations, perturb(T, xi, ABOUT), ABOUT)
    steps = 1e-6 * np.eye(6)
    gradient = np.array([(cost(xi + h) - cost(xi - h)) / 2e-6 for h in steps])
    # Second order in rotations of 3e-4 rad.
    np.testing.assert_allclose(held.g_anchor, gradient, rtol=2e-3, atol=1e-3 * np.abs(gradient).max())
    np.testing.assert_allclose(held.H_anchor @ xi, held.g_anchor, rtol=1e-9)


def test_a_strong_anchor_keeps_the_transform_and_a_weak_one_lets_it_go():
    a, b = sheets.pair()
    moved = perturb(sheets.T_TRUE, [0, 0, 0, 0.3, 0, 0], np.zeros(3))

    def distance_mm(sigma_mm):
        anchor = Anchor(moved, a.keypoints.points_sensor[:50], sigma_mm)
        T = refine_pair(a, b, moved, anchor=anchor).T_a_b
        points = b.keypoints.points_sensor
        return np.linalg.norm(transform_points(T, points) - transform_points(moved, points), axis=1).mean()

    assert distance_mm(1e-6) < 0.01
    # The textures of the sheets are strong: they bring it back by all of the 0.3 mm.
    assert distance_mm(10.0) == pytest.approx(0.3, abs=0.03)
