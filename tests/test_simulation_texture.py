from dataclasses import replace

import numpy as np
import pytest

from planish import _core
from planish.simulation.surfaces import Plate
from planish.simulation.texture import BLANK, Grain, Marks, Texture, kernel_texture, reflectance
from reference import lattice_noise, philox

#: float32 sums in the kernel against float64.
FLOAT32 = 2e-6
#: Straight pieces of the normal quantile.
QUANTILE = 1e-4


def grid(size_mm, pitch_mm):
    axis = np.arange(-size_mm / 2, size_mm / 2, pitch_mm)
    return np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2), len(axis)


@pytest.mark.parametrize("contrast", [0.001, 0.02, 0.05])
def test_the_grain_has_the_contrast_that_was_asked_for(contrast):
    at = np.random.default_rng(0).uniform(-300, 300, (200_000, 2))
    value = reflectance(replace(BLANK, grain=Grain(contrast)), Plate(), at, 3)
    # 600 mm hold thousands of the broadest streaks: 3 % is three of the estimate's own standard deviations.
    assert value.std() / value.mean() == pytest.approx(contrast, rel=0.03)


def test_the_grain_agrees_with_its_twin():
    at = np.random.default_rng(1).uniform(-400, 400, (2000, 2))
    texture = replace(BLANK, grain=Grain(0.05, angle_rad=0.7))
    values = kernel_texture(texture, 500, 350, 8)
    expected = texture.albedo * lattice_noise.grain(values["grain"], at[:, 0], at[:, 1])
    assert np.abs(reflectance(texture, Plate(), at, 8) - expected).max() < FLOAT32


def test_the_grain_is_long_along_the_brush_and_fine_across():
    at, n = grid(100.0, 0.25)
    value = reflectance(replace(BLANK, grain=Grain(0.02)), Plate(), at, 2).reshape(n, n)
    value -= value.mean()

    def correlation(shift, axis):
        return (value * np.roll(value, shift, axis)).mean() / value.var()

    along_2mm, across_2mm = correlation(8, 1), correlation(8, 0)
    assert along_2mm > 0.6
    assert across_2mm < 0.3


def test_the_grain_does_not_repeat():
    at, n = grid(150.0, 0.3)
    value = reflectance(replace(BLANK, grain=Grain(0.02)), Plate(), at, 4).reshape(n, n)
    spectrum = np.abs(np.fft.fft2(value - value.mean())) ** 2
    correlation = np.fft.ifft2(spectrum).real / spectrum.mean()
    distance = np.hypot(*np.meshgrid(np.fft.fftfreq(n) * 150, np.fft.fftfreq(n) * 150))
    # Five standard deviations of the correlation of independent fields of this size (some 1000 streaks).
    assert np.abs(correlation[distance > 60]).max() < 0.16


def test_another_seed_gives_another_texture_and_the_same_seed_the_same():
    at = np.random.default_rng(2).uniform(-300, 300, (5000, 2))
    first, again, other = (reflectance(Texture(), Plate(), at, seed) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.1


@pytest.mark.parametrize("layer", ["scratches", "specks", "smudges"])
def test_marks_stand_as_densely_as_asked_and_reach_their_contrast(layer):
    marks = Marks(50.0, 0.3, (2.0, 2.0), (0.3, 0.3) if layer == "scratches" else (2.0, 2.0))
    values = kernel_texture(replace(BLANK, **{layer: marks}), 500, 350, 5)["marks"]
    expected = 50.0 * 70
    assert abs(len(values) - expected) < 4 * np.sqrt(expected)
    dark = reflectance(replace(BLANK, **{layer: marks}), Plate(), values[:, 1:3], 5) / BLANK.albedo
    # Streaks within a smudge vary around three quarters of its contrast; a few marks lie on top of each other.
    full = 0.75 if layer == "smudges" else 1.0
    assert abs(np.median(dark - (1 + full * values[:, 7]))) < 0.02


def test_no_marks_and_no_grain_leave_the_bare_albedo():
    at = np.random.default_rng(3).uniform(-300, 300, (100, 2))
    assert np.array_equal(reflectance(BLANK, Plate(), at, 1), np.full(100, 0.55))
    assert np.array_equal(reflectance(Texture().with_density(0).with_grain(0), Plate(), at, 1), np.full(100, 0.55))


def test_the_generator_gives_the_known_answer_of_philox():
    # Random123, kat_vectors: philox4x32 10, counter and key all ones.
    ones = 0xFFFFFFFF
    assert philox.philox_4x32([ones] * 4, [ones] * 2) == [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]


def test_normal_numbers_agree_with_their_twin_and_are_normal():
    out = np.empty(4000, np.float32)
    _core.normal_numbers((7 << 32) + 5, (3 << 32) + 9, out)
    assert np.abs(out - philox.normal_numbers((7 << 32) + 5, (3 << 32) + 9, 4000)).max() < QUANTILE
    many = np.empty(1_000_000, np.float32)
    _core.normal_numbers(1, 2, many)
    four_sigma = 4 / np.sqrt(len(many))
    assert abs(many.mean()) < four_sigma
    assert abs(many.var() - 1) < four_sigma * np.sqrt(2)
    assert abs((many**4).mean() - 3) < four_sigma * np.sqrt(96)
    assert abs((many[1:] * many[:-1]).mean()) < four_sigma
