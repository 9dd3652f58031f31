"""The statistical patterns: bounds, periods, and that every place differs from every other."""

import numpy as np
import pytest

from planish.sensing.patterns.statistical import statistical_profile

#: Images per sequence and their shortest period, as recommended.
IMAGES, PERIOD_PX = 10, 12.0


def vectors(coordinates, count=IMAGES, seed=1):
    values = np.stack([statistical_profile(coordinates, k, seed, PERIOD_PX) for k in range(count)], -1)
    values = values - values.mean(-1, keepdims=True)
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def test_the_profile_is_the_same_for_ever():
    found = statistical_profile([0, 1, 2.5, 1279], 3, 7, 12.0)
    # Written down when the pattern was defined: captures taken with it must stay readable.
    assert found == pytest.approx([0.2886451257, 0.4596529322, 0.7185767023, 0.4225718417], abs=1e-9)


@pytest.mark.parametrize("index", range(6))
def test_brightness_uses_the_whole_range_about_its_middle(index):
    profile = statistical_profile(np.arange(0, 1280, 0.25), index)
    assert 0 <= profile.min() < 0.01
    assert 0.99 < profile.max() <= 1
    assert profile.mean() == pytest.approx(0.5, abs=0.03)
    assert profile.std() == pytest.approx(np.sqrt(1 / 8), abs=0.01)  # that of a cosine of full contrast


def test_no_period_is_shorter_than_the_shortest():
    x = np.arange(0, 4000, 0.05)
    for index in range(12):
        bright = statistical_profile(x, index, 1, PERIOD_PX) > 0.5
        rises = x[1:][bright[1:] & ~bright[:-1]]
        assert np.diff(rises).min() > PERIOD_PX


def test_consecutive_images_are_uncorrelated():
    x = np.arange(0, 4000.0)
    profiles = np.stack([statistical_profile(x, k) for k in range(20)])
    correlation = np.corrcoef(profiles) - np.eye(20)
    # About 250 periods: chance makes correlations of 0.06.
    assert np.abs(correlation).max() < 0.3
    assert np.sqrt((correlation**2).mean()) < 0.1


@pytest.mark.parametrize("seed", [1, 2])
def test_any_two_places_of_a_large_projector_differ_in_ten_images(seed):
    x = np.arange(0, 4000.0)
    b = vectors(x, seed=seed)
    for start in range(0, len(x), 500):
        correlation = b[start : start + 500] @ b.T
        correlation[np.abs(x[start : start + 500, None] - x) < PERIOD_PX] = -1
        assert correlation.max() < 0.999
        # Places that look alike within 1 - NCC^2 = 0.05 are rare.
        assert (correlation > 0.975).mean() < 3e-5


def test_another_seed_is_another_pattern():
    x = np.arange(0, 4000.0)
    assert abs(np.corrcoef(statistical_profile(x, 0, 1), statistical_profile(x, 0, 2))[0, 1]) < 0.3


@pytest.mark.parametrize("wrong", [{"index": -1}, {"index": 0, "seed": -1}, {"index": 0, "min_period_px": 0.0}])
def test_values_without_a_meaning_are_refused(wrong):
    with pytest.raises(ValueError, match="found"):
        statistical_profile(0.0, **wrong)
