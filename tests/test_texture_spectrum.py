from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import sheets
from planish.registration.refine.filtering import filter_texture
from planish.registration.refine.spectrum import Grid, seen_apart, texture_spectrum

SIZE = (256, 240)
KNOWN, GRID = np.ones(SIZE, bool), Grid(SIZE)
#: Spectra averaged over 0.004 cycles per pixel rest on some 12 frequencies here: 30 % each.
SCATTER = 0.3


def smooth_noise(rng, sigma_px):
    """Noise of unit variance without frequencies above about 1 / (2 pi sigma)."""
    noise = gaussian_filter(rng.standard_normal(SIZE), sigma_px, mode="wrap")
    return noise / noise.std()


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_noise_that_is_not_white_is_no_texture(rng):
    coloured = [0.95 * rng.standard_normal(SIZE) + 0.3 * smooth_noise(rng, 1.0) for _ in range(2)]
    mean = sum(coloured) / np.sqrt(2)
    alone = texture_spectrum(mean, KNOWN, GRID)
    known_apart = texture_spectrum(mean, KNOWN, GRID, (coloured[0], coloured[1]))
    assert (alone.signal > 0.5).mean() > 0.01
    # What is left is what exceeds twice the stated noise, and chance.
    assert known_apart.signal.sum() < 0.5 * alone.signal.sum()
    assert known_apart.noise.max() > 1.5


def test_texture_far_below_the_noise_is_found_where_two_cameras_saw_it(rng):
    texture = smooth_noise(rng, 6.0)
    seen = [0.15 * texture + rng.standard_normal(SIZE) for _ in range(2)]
    mean = sum(seen) / np.sqrt(2)
    found = texture_spectrum(mean, KNOWN, GRID, (seen[0], seen[1]))
    slow = np.hypot(*np.meshgrid(np.fft.rfftfreq(SIZE[1]), np.fft.fftfreq(SIZE[0]))) < 0.02
    assert (found.signal[slow] > 0).mean() > 0.9
    assert (found.signal[~slow] > 0).mean() < 0.2


def test_spectra_are_per_pixel_and_in_units_of_the_noise(rng):
    texture = 3 * rng.standard_normal(SIZE)
    seen = [texture + rng.standard_normal(SIZE) for _ in range(2)]
    found = texture_spectrum(texture + rng.standard_normal(SIZE), KNOWN, GRID, (seen[0], seen[1]))
    assert np.median(found.signal) == pytest.approx(9.0, rel=SCATTER)
    assert np.median(found.noise) == pytest.approx(1.0, rel=SCATTER)


def test_the_filter_keeps_what_both_cameras_saw_and_says_what_noise_it_passes(rng):
    texture = smooth_noise(rng, 3.0)
    noises = [rng.standard_normal(SIZE) for _ in range(2)]
    value, sigma = 0.5 * texture + sum(noises) / 2, np.full(SIZE, np.sqrt(0.5))
    apart = tuple((0.5 * texture + noise) / sigma for noise in noises)
    found = filter_texture(value.astype(np.float32), sigma.astype(np.float32), 30.0, apart)
    assert np.corrcoef(found.value.ravel(), texture.ravel())[0, 1] > 0.9
    left = filter_texture((sum(noises) / 2).astype(np.float32), sigma.astype(np.float32), 30.0, apart)
    assert 0 < found.noise_passed < 0.1
    assert left.noise_passed == pytest.approx(found.noise_passed, rel=SCATTER)


def test_what_one_camera_alone_saw_is_not_seen_apart():
    m = sheets.quiet("a", 0.0)
    sigma, inside = np.full(m.shape, 0.01, np.float32), m.valid
    assert seen_apart(replace(m, texture_views=m.texture_views[:1]), inside, sigma, 5.0) is None


#: A spectrum's chance at these sizes, of what the filter passes.
PASSED_ALIKE = 0.01


def test_what_a_filter_passes_does_not_depend_on_how_fine_its_cells_are(rng):
    """A low-pass of the shading of few pixels takes a large part of all frequencies."""
    strong = 5 * rng.standard_normal((1024, 1024)).astype(np.float32)
    small = strong[:400, :400]
    assert [Grid.of(v.shape).step for v in (small, strong)] == [1, 2]
    passed = [filter_texture(v, np.ones_like(v), 1.5).noise_passed for v in (small, strong)]
    assert passed[1] == pytest.approx(passed[0], rel=PASSED_ALIKE)
