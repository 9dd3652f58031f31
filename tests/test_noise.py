"""The noise model is found from the sequence alone."""

import numpy as np
import pytest

from planish import _core
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.noise.estimate import estimate_image_noise, estimate_noise, full_scale
from planish.sensing.noise.grey_range import grey_range
from planish.sensing.patterns.statistical import statistical_profile
from reference import sensing as reference
from sequences import gray_entries, manifest, phase_entries, render

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


def test_samples_and_their_variance_equal_the_numpy_twin():
    rng = np.random.default_rng(4)
    images = [rng.integers(20, 256, (12, 61), dtype=np.uint8) for _ in range(4)]
    weights = [0.5, -0.5, 0.5, -0.5]
    for along_rows in (False, True):
        found = _core.sample_noise(images, weights, [0, 4, 9], along_rows, False, 250.0)
        expected = reference.noise_sample(images, weights, [0, 4, 9], along_rows, 250)
        # Single precision at 255 grey levels.
        assert np.allclose(found, expected, atol=2e-4)
    level, residual = rng.uniform(0, 100, 5000).astype(np.float32), rng.standard_normal(5000).astype(np.float32)
    means, variances, counts = _core.bin_noise(level, residual, 5, 2.5, 0.1)
    bins = np.minimum(((level - level.min()) * (5 / np.ptp(level))).astype(int), 4)
    assert counts.tolist() == np.bincount(bins).tolist()
    for k in range(5):
        assert means[k] == pytest.approx(level[bins == k].mean(), rel=1e-5)
        assert variances[k] == pytest.approx(reference.clipped_variance(residual[bins == k], 2.5, 0.1), rel=1e-5)


def test_fringes_along_the_columns_do_not_count_as_noise():
    """Second differences down a column of such fringes hold their harmonics: those along the rows are taken."""
    plan = manifest([entry | {"axis": "v"} for entry in phase_entries([20], 4)])
    positions = np.tile(np.linspace(0, 200, 240)[:, None], (1, 320))
    rng = np.random.default_rng(0)
    images = [
        np.round(220 * (image / 65535) ** 2.2 + 1.5 * rng.standard_normal(image.shape)).clip(0, 255).astype(np.uint8)
        for image in render(plan.sequence, positions, bits=16, offset=60, amplitude=180)
    ]
    model = estimate_noise(images, read_layouts(plan, "test")[0], 255.0)
    assert model.offset + model.slope * 80 == pytest.approx(1.5**2 + 1 / 12, rel=RELATIVE)


def test_the_noise_of_a_gray_code_alone_comes_from_its_pairs():
    plan = manifest(gray_entries(5, 10, inverse=True), projector_px=(320, 200))
    positions = np.tile(np.linspace(0, 319, 320), (240, 1))
    albedo = 0.3 + 0.7 * np.random.default_rng(1).random((240, 320))
    rng, images = np.random.default_rng(2), []
    for image in render(plan.sequence, positions, bits=16):
        grey = 255 * (image / 65535) * albedo
        images.append(np.round(grey + 1.2 * rng.standard_normal(grey.shape)).clip(0, 255).astype(np.uint8))
    model = estimate_noise(images, read_layouts(plan, "test")[0], 255.0)
    assert model.offset + model.slope * 80 == pytest.approx(1.2**2 + 1 / 12, rel=RELATIVE)


def test_levels_16_apart_make_a_noise_of_their_own():
    images, layout = images_of(phase_entries([320, 40], 4))
    deep = [np.clip(np.round(image / 8.0), 0, 31).astype(np.uint16) * 2048 for image in images]
    assert grey_range([], deep).step == 2048
    model = estimate_noise(deep, layout, 65535.0)
    assert model.offset + model.slope * 20000 >= 2048**2 / 12


@pytest.mark.parametrize(("full", "dtype"), [(250, np.uint8), (1000, np.uint16)])
def test_a_sensor_that_ends_below_full_scale_is_found_by_the_spike_at_its_end(full, dtype):
    plan = manifest(phase_entries([320, 40], 4), projector_px=(320, 200))
    positions = np.tile(np.linspace(0, 319, 320), (240, 1))
    light = np.linspace(0.3, 1.3, 240)[:, None]
    rng, images = np.random.default_rng(2), []
    for image in render(plan.sequence, positions, bits=16):
        grey = full * (image / 51400) * light + 0.01 * full * rng.standard_normal(image.shape)
        images.append(np.clip(np.round(grey), 0, full).astype(dtype))
    (layout,) = read_layouts(plan, "test")
    assert full_scale(images, layout) == full
    # The same scene in half the light is cut nowhere: its brightest level is no end.
    dim = [(image // 2).astype(dtype) for image in images]
    noisy = [np.minimum(image + rng.integers(0, 9, image.shape), full).astype(dtype) for image in dim]
    assert full_scale(noisy, layout) == (255 if dtype == np.uint8 else 1023)


def test_the_crest_of_fringes_without_noise_is_no_end_of_the_sensor():
    plan = manifest(phase_entries([320, 40], 4), projector_px=(320, 200))
    images = render(plan.sequence, np.tile(np.linspace(0, 319, 640), (240, 1)))
    assert full_scale(images, read_layouts(plan, "test")[0]) == 255


@pytest.mark.parametrize("across", [False, True])
def test_statistical_patterns_tell_their_noise_over_time(across):
    """Gains of a texture that varies from pixel to pixel, and stripes, must not count as noise, along either axis."""
    rng, shape = np.random.default_rng(8), (240, 320)
    positions = np.tile(np.linspace(0, 300, shape[1]), (shape[0], 1)) + np.linspace(0, 3, shape[0])[:, None]
    albedo = 0.3 + 0.7 * rng.random(shape)
    images = []
    for k in range(12):
        grey = 15 + 200 * albedo * statistical_profile(positions, k)
        grey += rng.standard_normal(shape) * np.sqrt(OFFSET + SLOPE * grey)
        image = np.clip(np.round(grey), 0, 255).astype(np.uint8)
        images.append(np.ascontiguousarray(image.T) if across else image)
    (layout,) = read_layouts(manifest([{"role": "statistical", "index": k} for k in range(12)]), "test")
    model = estimate_noise(images, layout, 255.0)
    for level in (60.0, 120.0):
        assert model.offset + model.slope * level == pytest.approx(OFFSET + SLOPE * level + 1 / 12, rel=RELATIVE)
