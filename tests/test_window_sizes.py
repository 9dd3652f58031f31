"""Measurements of little surface: windows small enough to speak for them, and words where even these are too few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import motions
from motions import T_MOVED
from planish.registration.verdict.window_sizes import VerifyOptions, area_mm2, for_areas, too_small

STILL = np.eye(4)
#: A right transform, refined, anywhere on the small piece [mm]: a tenth of a pixel.
RIGHT_MM = 0.1


def cut(m, rows, columns):
    """The measurement with its points in these rows and columns (slices) only."""
    points = np.full_like(m.points_sensor, np.nan)
    points[rows, columns] = m.points_sensor[rows, columns]
    return replace(m, points_sensor=points)


def small(texture, seed, T=T_MOVED, name="b"):
    """A piece of some 70 mm of the part."""
    return cut(motions.measured(T, texture, name, seed), np.s_[140:215], np.s_[200:275])


def test_large_measurements_have_windows_of_the_full_size():
    images = motions.side(motions.measured(STILL, motions.grain(), "a", 1)).images
    options = VerifyOptions(window_mm=10.0)
    assert for_areas(images, images, options) == options
    assert not too_small(images, options)


@pytest.mark.parametrize("order", [1, -1])
def test_the_smaller_of_two_measurements_decides_the_size(order):
    large = motions.side(motions.measured(STILL, motions.grain(), "a", 1)).images
    little = motions.side(small(motions.grain(), 2)).images
    assert area_mm2(little) < 0.1 * area_mm2(large)
    options = VerifyOptions(window_mm=28.0)
    found = for_areas(*(large, little)[::order], options)
    assert 14.0 <= found.window_mm < 28.0


def test_a_small_piece_of_a_part_is_found():
    a, b = motions.measured(STILL, motions.grain(), "a", 1), small(motions.grain(), 2)
    result = motions.registered(a, b)
    assert result.status == "accepted"
    assert result.windows >= 9
    assert motions.worst_mm(result.T_a_b, T_MOVED, b) < RIGHT_MM


@pytest.mark.parametrize("seed", range(20, 23))
def test_a_small_piece_of_another_part_is_refused(seed):
    a, b = motions.measured(STILL, motions.grain(), "a", 1), small(motions.grain(0.03, seed), seed)
    assert motions.registered(a, b).status == "refused"


def test_hardly_any_surface_is_named_with_its_area():
    a = motions.measured(STILL, motions.grain(), "a", 1)
    speck = cut(motions.measured(T_MOVED, motions.grain(0.03, 9), "b", 2), np.s_[150:180], np.s_[200:230])
    result = motions.registered(a, speck)
    assert result.status == "refused"
    assert "cm2 of surface" in result.reason
