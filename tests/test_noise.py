"""The noise model is found from the sequence alone."""

import numpy as np
import pytest

from planish.sensing.noise import estimate_image_noise, estimate_noise, full_scale
from planish.sensing.sequence import read_layouts
from sequences import manifest, phase_entries, render

OFFSET, SLOPE = 1.6, 0.03
#: 70,000 samples in 24 bins give the variance within 1 %; rounding adds 1/12; the line's ends less.
RELATIVE = 0.06


def images_of(entries, shape=(240, 320), gamma=1.0, seed=3):
    plan = manifest(entries, projector_px=(320, 200))
    positions = np.tile(np.linspace(0, 319, shape[1]), (shape[0], 1)) + np.linspace(0, 3, shape[0])[:, None]
    # Albedo varies along the rows by a factor of three: a texture that must not count as noise.
    albedo = 0.3 + 0.7 * np.random.default_rng(seed).random(shape)
    rng, images = np.random.default_rng(seed), []
    for image in render(plan.sequence, positions, bits=16):
        grey = 255 * (image / 65535 * albedo) ** gamma
        grey += rng.standard_normal(shape) * np.sqrt(OFFSET + SLOPE * grey)
        images.append(np.clip(np.round(grey), 0, 255).astype(np.uint8))
    return images, read_layouts(plan, "test")[0]


@pytest.mark.parametrize(
    ("periods", "steps"), [([320, 40], 4), ([320], 5), ([320, 40], 6), ([320], 12), ([320, 40], 3)]
)
def test_variance_follows_the_grey_level(periods, steps):
    images, layout = images_of(phase_entries(periods, steps))
    model = estimate_noise(images, layout, 255.0)
    for level in (60.0, 120.0):
        assert model.offset + model.slope * level == pytest.approx(OFFSET + SLOPE * level + 1 / 12, rel=RELATIVE)


@pytest.mark.parametrize("steps", [5, 7])
def test_an_odd_number_of_steps_over_a_part_of_a_period_biases_nothing(steps):
    # Steps of odd N weigh differently: where the field holds a part of a period, some grey levels weigh more.
    images, layout = images_of(phase_entries([900], steps))
    model = estimate_noise(images, layout, 255.0)
    for level in (60.0, 120.0):
        assert model.offset + model.slope * level == pytest.approx(OFFSET + SLOPE * level + 1 / 12, rel=RELATIVE)


def test_harmonics_of_a_gamma_are_no_noise():
    images, layout = images_of(phase_entries([320, 40], 4), gamma=1.0 / 1.3)
    model = estimate_noise(images, layout, 255.0)
    # Albedo noise makes neighbouring rows differ in the harmonic's amplitude: that part stays, a fifth at this gamma.
    assert model.offset + model.slope * 100 == pytest.approx(OFFSET + SLOPE * 100, rel=0.5)


def test_a_single_image_gives_an_upper_bound():
    rng = np.random.default_rng(0)
    grey = 100 + rng.standard_normal((300, 300)) * 2
    model = estimate_image_noise(np.round(grey).astype(np.uint8))
    assert model.offset + model.slope * 100 == pytest.approx(4 + 1 / 12, rel=RELATIVE)


def test_too_few_unsaturated_pixels_give_a_usable_model():
    images, layout = images_of(phase_entries([320, 40], 4), shape=(12, 12))
    model = estimate_noise([np.full_like(image, 255) for image in images], layout, 255.0)
    assert model.offset > 0


@pytest.mark.parametrize(("brightest", "expected"), [(900, 1023), (4095, 4095), (60000, 65472), (65535, 65535)])
def test_the_full_scale_of_deep_images_is_that_of_their_sensor(brightest, expected):
    assert full_scale([np.array([[1, brightest]], np.uint16)]) == expected
