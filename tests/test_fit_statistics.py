"""The size of the residuals judges a fit: wrong optima, other surfaces, textures that have nothing in common."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import sheets
from planish.geometry import perturb
from planish.registration.pair import kept_out_agreement, refine_pair, residual_statistics
from planish.registration.prepared import prepare
from planish.registration.refine.covariance import noise_covariance
from planish.registration.refine.filtering import filter_texture
from planish.registration.refine.solve import RefineOptions
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.geometry import Sight
from planish.registration.verdict.hypothesis import as_hypothesis
from planish.registration.verdict.judge import VerdictOptions, judge_refined
from planish.registration.verdict.window_sizes import VerifyOptions

CLEAR, OPTIONS = Sight(meet=1000, hidden=0), VerdictOptions()
CENTRE = [30, 10, 0]
#: Textures and surfaces as noisy as stated: their residuals are known to a few percent.
SCALE_TOLERANCE = 0.15


@pytest.fixture(scope="module")
def pair():
    return sheets.pair()


@pytest.fixture(scope="module")
def refined(pair):
    return refine_pair(*pair, sheets.T_TRUE)


def drift_of(pair, refined):
    return hypothesis(pair).drift(refined.T_a_b, sheets.PITCH_MM)


def hypothesis(pair):
    a, b = (Side(p.measurement, p.images, p.contrast) for p in pair)
    return as_hypothesis(a, b, sheets.T_TRUE, VerifyOptions())


def test_a_right_fit_leaves_what_noise_makes(pair, refined):
    found = residual_statistics(*pair, refined)
    assert found.distance_scale == pytest.approx(1, abs=SCALE_TOLERANCE)
    assert found.distance_mm < sheets.SIGMA_MM
    assert found.common_texture > 0.95
    assert found.correlation_sigma > 20
    assert judge_refined(refined, (), drift_of(pair, refined), CLEAR, OPTIONS, fit=found) is None


def test_a_wrong_optimum_that_the_tiles_kept_out_share_is_refused_by_its_textures(pair):
    """From millimetres off without coarse levels: the slopes lead to where the texture looks a little alike."""
    options = sheets.OPTIONS.model_copy(update={"refine": RefineOptions(spacing_px=(1,), max_distance_mm=(3.0,))})
    wrong = refine_pair(*pair, perturb(sheets.T_TRUE, [0, 0, 0, 9, -12, 0], CENTRE), options)
    assert wrong.converged
    assert not kept_out_agreement(*pair, wrong, noise_covariance(wrong)).contradicts
    found = residual_statistics(*pair, wrong)
    assert found.common_texture < 0.3
    judged = judge_refined(wrong, (), drift_of(pair, replace(wrong, T_a_b=sheets.T_TRUE)), CLEAR, OPTIONS, fit=found)
    assert judged.status == "refused"
    assert "% of their variance in common" in judged.reason or "do not correlate" in judged.reason


def test_a_surface_that_was_bent_is_refused_by_its_distances(pair):
    a, b = pair
    m = b.measurement
    rows, columns = np.indices(m.shape) / 60.0
    dents = (np.sin(2 * np.pi * rows) * np.sin(2 * np.pi * columns)).astype(np.float32)
    rays = m.points_sensor - m.camera.center_sensor.astype(np.float32)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    bent = replace(m, points_sensor=m.points_sensor + dents[..., None] * rays)
    other = prepare(bent, sheets.PITCH_MM)
    refined = refine_pair(a, other, sheets.T_TRUE)
    found = residual_statistics(a, other, refined)
    assert found.distance_mm > OPTIONS.max_residual_mm
    judged = judge_refined(refined, (), drift_of(pair, refined), CLEAR, OPTIONS, fit=found)
    assert judged.status == "refused"
    assert "mm apart" in judged.reason


def test_noise_alone_says_nothing_about_the_textures(refined):
    """Twice the noise that is stated would explain all that is seen: the verdict does not rest on such a texture."""
    a, b = (
        prepare(sheets.noisy(sheets.quiet(s, sheets.BENT, 0.001), i, 4.0), sheets.PITCH_MM) for i, s in enumerate("ab")
    )
    found = residual_statistics(a, b, replace(refined, T_a_b=perturb(sheets.T_TRUE, [0, 0, 0, 9, -12, 0], CENTRE)))
    assert found.most_common_texture == 1


def test_a_drift_to_the_next_optimum_is_refused_and_one_within_a_pixel_is_not(pair, refined):
    near, far = (
        hypothesis(pair).drift(perturb(sheets.T_TRUE, [0, 0, 0, shift, 0, 0], CENTRE), sheets.PITCH_MM)
        for shift in (0.3 * sheets.PITCH_MM, 0.75 * sheets.PITCH_MM)
    )
    # Below what may be left at all.
    assert far.mm < OPTIONS.max_drift_mm
    assert judge_refined(refined, (), near, CLEAR, OPTIONS) is None
    judged = judge_refined(refined, (), far, CLEAR, OPTIONS)
    assert judged.status == "refused"
    assert "left the consensus" in judged.reason


def test_the_pixels_per_independent_value_are_those_of_correlations_of_unrelated_textures():
    rng = np.random.default_rng(4)
    shape = 192, 192
    textures = []
    for _ in range(24):
        grain = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 2.0, sigmaY=0.8)
        value = (grain / grain.std() + 0.3 * rng.standard_normal(shape)).astype(np.float32)
        textures.append(filter_texture(value, np.full(shape, 0.3, np.float32), 20.0))
    correlations = [
        np.corrcoef(p.value.ravel(), q.value.ravel())[0, 1] for i, p in enumerate(textures) for q in textures[:i]
    ]
    expected = np.mean([t.pixels_per_value for t in textures])
    # 276 correlations know their variance to 9 %; spectra are averaged over some of their width.
    assert np.var(correlations) * shape[0] * shape[1] == pytest.approx(expected, rel=0.3)
