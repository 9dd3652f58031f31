"""Gaussian averages from fewer samples: as good as those of all pixels, and the same of what is smooth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from planish.registration.refine.smoothing import smooth_map

#: Share of an average's own standard deviation: linear interpolation over half of the Gaussian's errs in the middle by
#: an eighth of the squared step times the average's second derivative, which is of noise sqrt(3) / 2 of it per squared
#: deviation: 2.7 % along each axis.
OF_NOISE = 0.05
#: Linear interpolation errs by an eighth of the curvature times the squared step: of a step smoothed by a Gaussian at
#: most 0.242 / (8 * 2^2) along each axis.
OF_SMOOTH = 1.6e-2


def averaged(image, rows_px, columns_px):
    return gaussian_filter(image.astype(float), (rows_px, columns_px), mode="constant", truncate=6)


@pytest.mark.parametrize(("rows_px", "columns_px"), [(1.5, 2.0), (9.0, 13.0), (17.0, 17.0)])
@pytest.mark.parametrize("shape", [(320, 351), (403, 260)])
def test_averages_of_noise_are_as_those_of_all_pixels(rows_px, columns_px, shape):
    image = np.random.default_rng(3).standard_normal(shape).astype(np.float32)
    expected, found = averaged(image, rows_px, columns_px), smooth_map(image, rows_px, columns_px)
    assert np.std(found - expected) < OF_NOISE * np.std(expected)
    assert np.std(found) == pytest.approx(np.std(expected), rel=OF_NOISE)


@pytest.mark.parametrize("sigma_px", [2.0, 11.0, 16.0])
def test_what_is_smooth_is_averaged_alike_up_to_the_rim(sigma_px):
    v, u = np.indices((203, 160))
    image = (1 + 0.5 * np.sin(u / (4 * sigma_px)) + 0.3 * np.cos(v / (5 * sigma_px))).astype(np.float32)
    found = smooth_map(image, sigma_px, 1.2 * sigma_px)
    np.testing.assert_allclose(found, averaged(image, sigma_px, 1.2 * sigma_px), atol=OF_SMOOTH * image.max())
