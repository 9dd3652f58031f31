"""A texture that repeats in itself is recognised, and what only resembles itself here and there is not."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

import sheets
import synthetic
from planish.pipeline import prepare_run
from planish.registration.pair import register_pair
from planish.registration.texture.periods import find_period
from planish.registration.verdict.aligned import Side
from planish.registration.verdict.hypothesis import as_hypothesis
from planish.registration.verdict.lattice import as_good_a_period_off

PITCH_MM, SIZE_PX, NOISE = 1.0, 200, 0.01
#: Places between pixels are told to an eighth of one.
PERIOD_TOLERANCE_PX = 0.25
ROWS, COLUMNS = np.mgrid[:SIZE_PX, :SIZE_PX].astype(float)


def turned(angle_deg):
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return c * COLUMNS + s * ROWS, c * ROWS - s * COLUMNS


def chessboard(square_px, angle_deg=20):
    x, y = turned(angle_deg)
    return np.sign(np.sin(np.pi * x / square_px) * np.sin(np.pi * y / square_px))


def dots(pitch_px, angle_deg=20):
    x, y = (np.mod(n, pitch_px) - pitch_px / 2 for n in turned(angle_deg))
    return np.where(np.hypot(x, y) < 0.3 * pitch_px, 1.0, 0.0)


def stripes(pitch_px, angle_deg=20):
    return np.sign(np.sin(2 * np.pi * turned(angle_deg)[0] / pitch_px))


def period_of(texture, noise=NOISE, contrast=0.2, seed=1):
    """The period that is found where the texture is seen by a lens, with noise."""
    seen = cv2.GaussianBlur(contrast * texture.astype(np.float32), (0, 0), 0.7)
    seen += np.random.default_rng(seed).standard_normal(seen.shape).astype(np.float32) * noise
    known = np.ones(seen.shape, bool)
    known[:30, :50] = False
    return find_period(seen, np.full(seen.shape, noise, np.float32), known, PITCH_MM)


@pytest.mark.parametrize("square_px", [4.3, 7.0, 20.0])
def test_a_chessboard_repeats_along_its_diagonals(square_px):
    found = period_of(chessboard(square_px))
    assert found.period_mm == pytest.approx(np.sqrt(2) * square_px, abs=PERIOD_TOLERANCE_PX)
    assert found.cell_mm2 == pytest.approx(2 * square_px**2, rel=0.1)


@pytest.mark.parametrize("pitch_px", [5.0, 11.7, 30.0])
def test_dots_repeat_from_one_to_the_next(pitch_px):
    found = period_of(dots(pitch_px))
    assert found.period_mm == pytest.approx(pitch_px, abs=PERIOD_TOLERANCE_PX)
    assert found.cell_mm2 == pytest.approx(pitch_px**2, rel=0.1)


def test_stripes_repeat_along_one_direction_only():
    found = period_of(stripes(12.0))
    assert found.period_mm == pytest.approx(12.0, abs=PERIOD_TOLERANCE_PX)
    assert found.cell_mm2 is None


def grain(along_px, across_px, seed=2):
    noise = np.random.default_rng(seed).standard_normal((SIZE_PX, SIZE_PX)).astype(np.float32)
    relief = cv2.GaussianBlur(noise, (0, 0), along_px, sigmaY=across_px)
    return relief / relief.std()


def marks():
    drawn = np.zeros((SIZE_PX, SIZE_PX))
    for x, y in ((60, 80), (100, 80), (140, 80), (90, 150)):
        drawn[np.hypot(COLUMNS - x, ROWS - y) < 6] = 1
    return drawn


@pytest.mark.parametrize("texture", [grain(1.5, 1.5), grain(12, 0.8), grain(60, 1), marks()])
def test_grain_streaks_and_a_few_like_marks_do_not_repeat(texture):
    assert period_of(texture) is None


def test_a_pattern_on_which_as_much_grain_stands_does_not_repeat():
    assert period_of(chessboard(7.0) + grain(1.5, 1.5)) is None


def test_noise_and_nothing_do_not_repeat():
    assert period_of(np.zeros((SIZE_PX, SIZE_PX))) is None
    nothing = np.zeros((5, 5), np.float32)
    assert find_period(nothing, nothing, nothing > 0, PITCH_MM) is None


#: Squares of nine pixels of a small sensor.
SQUARE_MM = 12.0


def board(end_mm=np.inf):
    """Raster of a chessboard that ends so far from the middle."""
    n = round(2 * synthetic.RASTER_MM / synthetic.RASTER_PITCH_MM)
    mm = (np.arange(n) + 0.5) * synthetic.RASTER_PITCH_MM - synthetic.RASTER_MM
    dark = np.logical_xor(*np.meshgrid(np.floor(mm / SQUARE_MM) % 2 == 0, np.floor(mm / SQUARE_MM) % 2 == 0))
    inside = np.logical_and(*np.meshgrid(np.abs(mm) < end_mm, np.abs(mm) < end_mm))
    return np.where(dark & inside, np.float32(0.6), np.float32(1))


def seen(texture):
    """Two views of it, prepared with the options of their resolution."""
    a, b = (
        synthetic.measurement(T, texture, name=name, scale=sheets.SCALE, seed=seed)
        for seed, (name, T) in enumerate((("a", np.eye(4)), ("b", sheets.T_TRUE)))
    )
    options, prepared = prepare_run([a, b], threads=2)
    return prepared["a"], prepared["b"], options


def registered(texture):
    return register_pair(*seen(texture), threads=2)


@pytest.mark.parametrize("repeats", [True, False])
def test_a_right_motion_is_held_against_those_a_period_off(repeats):
    a, b, options = seen(board() if repeats else sheets.grain())
    sides = tuple(Side(p.measurement, p.images, p.contrast) for p in (a, b))
    first = as_hypothesis(*sides, sheets.T_TRUE, options.verdict.verify)
    other = as_good_a_period_off(*sides, first, options.verdict.verify, options.verdict.ambiguous_share)
    assert (other is not None) == repeats
    if repeats:
        off = sheets.errors_mm(other.T_a_b, sheets.T_TRUE, np.zeros((1, 3)))[0]
        assert off == pytest.approx(np.sqrt(2) * SQUARE_MM, abs=2 * PERIOD_TOLERANCE_PX * sheets.PITCH_MM)


@pytest.mark.parametrize("end_mm", [np.inf, 5 * SQUARE_MM])
def test_a_chessboard_is_ambiguous_or_right(end_mm):
    result = registered(board(end_mm))
    if result.status == "accepted":
        assert np.isfinite(end_mm)
        assert sheets.errors_mm(result.T_a_b, sheets.T_TRUE, np.zeros((1, 3))).max() < 1.0
    else:
        assert result.status == "ambiguous"
        assert "repeats" in result.reason or "looks the same" in result.reason


def test_a_pattern_finer_than_the_windows_is_ambiguous_by_its_period():
    """Windows are sought 16 mm around: every peak stands at one of many places of the pattern."""
    fine = cv2.resize(board(), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    result = registered(np.tile(fine, (2, 2)))
    assert result.status == "ambiguous"
    period = float(re.search(r"repeats every ([\d.]+) mm", result.reason).group(1))
    assert period == pytest.approx(SQUARE_MM / np.sqrt(2), abs=PERIOD_TOLERANCE_PX * sheets.PITCH_MM)
