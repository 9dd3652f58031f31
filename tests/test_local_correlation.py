"""Tiles are asked whether their textures correlate where a highlight rules the whole."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

import sheets
from planish.registration.pair import refine_pair
from planish.registration.refine.fit_statistics import fit_statistics
from planish.registration.refine.local_correlation import local_correlation_sigma
from planish.registration.refine.residuals import Weights, equations
from planish.registration.refine.solve import RefineOptions
from planish.registration.verdict.judge import VerdictOptions

#: Low-pass of the shading [px].
SHADING_PX = 8.0
LEAST_SIGMA = VerdictOptions().min_correlation_sigma
#: What unrelated textures do not exceed in so few cases.
CHANCE_SIGMA = 4.0
#: Sums of single precision.
ROUNDING = 1e-3
OPTIONS = RefineOptions()


@cache
def fitted():
    a, b = sheets.pair()
    return a.sides[1], b.sides[1], refine_pair(a, b, sheets.T_TRUE)


def textures():
    a, b, _ = fitted()
    return a.texture, b.texture


def by_tiles(texture_a, texture_b):
    a, b, refined = fitted()
    sides = (replace(side, texture=t.astype(np.float32)) for side, t in ((a, texture_a), (b, texture_b)))
    return local_correlation_sigma(*sides, refined, SHADING_PX, OPTIONS)


def glare():
    """A strong, finely structured highlight on a twenty-fifth of b."""
    texture = textures()[1]
    height, width = texture.shape
    fine = np.zeros(texture.shape, np.float32)
    middle = np.s_[height // 2 : height // 2 + height // 5, width // 2 : width // 2 + width // 5]
    fine[middle] = np.random.default_rng(3).standard_normal(fine[middle].shape)
    return 300 * np.nanstd(texture) * cv2.GaussianBlur(fine, (0, 0), 1.5)


def test_right_textures_correlate_in_their_tiles():
    assert by_tiles(*textures()) > 2 * LEAST_SIGMA


def test_a_highlight_counts_no_more_than_its_area():
    a, b, refined = fitted()
    dazzled = replace(b, texture=b.texture + glare())
    e = equations(
        a, dazzled, refined.T_a_b, refined.about, Weights.alike(b, 12), max_distance_mm=1.0, max_normal_rad=0.35,
        stride=1, tile_px=12, residuals=False, threads=1,
    )  # fmt: skip
    refined = replace(refined, equations=replace(refined.equations, correlation=e.correlation))
    whole = fit_statistics(a, dazzled, refined, OPTIONS)
    assert whole.correlation_sigma < LEAST_SIGMA
    assert fit_statistics(a, dazzled, refined, OPTIONS, 1, SHADING_PX).correlation_sigma > 2 * LEAST_SIGMA


@pytest.mark.parametrize("rows", [20, 45, 70, -30, -55])
def test_unrelated_textures_do_not_correlate(rows):
    a, b = textures()
    assert abs(by_tiles(a, np.roll(b, (rows, 2 * rows), (0, 1)))) < CHANCE_SIGMA


def test_the_stated_deviation_is_not_too_small():
    a, b = textures()
    shifts = [(r, c) for r in (-60, -35, 35, 60) for c in (-90, -45, 0, 45, 90)]
    found = [by_tiles(a, np.roll(b, shift, (0, 1))) for shift in shifts]
    assert np.sqrt(np.mean(np.square(found))) < 1.2


def test_shading_that_both_share_says_nothing():
    a, b = textures()
    unrelated = np.roll(b, (45, 90), (0, 1))
    level = 10 * np.nanstd(a)
    assert by_tiles(a + level, unrelated + level) == pytest.approx(by_tiles(a, unrelated), abs=ROUNDING)
