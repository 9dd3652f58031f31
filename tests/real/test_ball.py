"""A reference ball: its size is not known (the two focal lengths differ by 13 %), its form is."""

import numpy as np
import pytest
from captures import measured
from scipy.optimize import least_squares

from spread import robust_spread

#: Figures of the data's README and of the issue.
POINTS, DISC_SHARE, SPHERE_MM, FARTHEST_MM = 450_000, 0.97, 0.0085, 0.1
CENTER_PX, RADIUS_PX = (930, 601), 350


@pytest.fixture(scope="module")
def ball():
    return measured("ball_12step")


def test_enough_points_are_valid(ball):
    assert ball.valid.sum() >= POINTS


def test_the_disc_is_a_sphere_within_its_noise(ball):
    v, u = np.mgrid[: ball.shape[0], : ball.shape[1]]
    disc = (u - CENTER_PX[0]) ** 2 + (v - CENTER_PX[1]) ** 2 <= RADIUS_PX**2
    assert ball.valid[disc].mean() >= DISC_SHARE
    points = ball.points_sensor[disc & ball.valid].astype(float)
    start = np.append(points.mean(0) + [0, 0, 12], 13.0)
    fit = least_squares(
        lambda x: np.linalg.norm(points[::50] - x[:3], axis=1) - x[3], start, loss="soft_l1", f_scale=0.01
    ).x
    radial = np.linalg.norm(points - fit[:3], axis=1) - fit[3]
    assert robust_spread(radial) <= SPHERE_MM
    assert np.abs(radial).max() < FARTHEST_MM
    # What sigma states is noise alone: form and calibration add to it here.
    assert 0.5 * robust_spread(radial) < np.median(ball.sigma_mm[disc & ball.valid]) < 1.1 * robust_spread(radial)
