"""Movement during a sequence is measured in pixels, refused above a fifth of a pixel, and not invented."""

import numpy as np
import pytest

from planish import _core
from planish.errors import InputError
from planish.measurement import NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.checks.movement import check_movement, compare, drift
from planish.sensing.checks.still import stills, to_compare
from reference.shift_sums import shift_sums
from sequences import gray_entries, manifest, phase_entries
from textured import picture, sequence, texture

NOISE = NoiseModel(1.44 + 1 / 12, 0.025)
PERIODS = (1280, 160, 20)
#: Beyond three standard deviations one in 370 honest results lies; a movement is misjudged by 5 % of it besides.
SIGMAS, RELATIVE = 3.5, 0.05


def reference(steps=4, more=()):
    made = manifest([*phase_entries(PERIODS, steps), {"role": "white"}, *more], projector_px=[1280, 800])
    return made.sequence, read_layouts(made, "capture.json")


def moved(entries, contrast, shift, **options):
    fine = texture(contrast)
    before, after = picture(fine), picture(fine, shift)
    half = len(entries) // 2
    return sequence(entries, [before if k < half else after for k in range(len(entries))], **options)


def check(images, layouts):
    return check_movement(images, layouts, NOISE, 255.0, "A", "capture.json", 2)


def test_the_kernel_sums_what_its_reference_sums():
    rng = np.random.default_rng(3)
    first = (100 + 10 * rng.standard_normal((75, 90))).astype(np.float32)
    last = (0.7 * first + rng.standard_normal(first.shape)).astype(np.float32)
    usable = (rng.random(first.shape) > 0.002).astype(np.uint8)
    expected = shift_sums(first, last, usable, 1.4, 0.02, 0.25, 0.5)
    found = [_core.shift_sums(first, last, usable, 1.4, 0.02, 0.25, 0.5, threads) for threads in (1, 3)]
    assert found[0].tobytes() == found[1].tobytes()
    # Single precision over 256 products.
    assert np.abs(found[0] - expected).max() <= 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize("contrast", [0.01, 0.1])
@pytest.mark.parametrize("length", [0.0, 0.1, 0.2, 0.3, 0.5])
def test_a_known_shift_is_measured_within_its_sigma(contrast, length):
    entries, layouts = reference()
    truth = length * np.array([0.8, -0.6])
    images = moved(entries, contrast, truth)
    found = compare(images, *to_compare(stills(layouts))[0], NOISE, 255.0, 2).everywhere
    assert found.seen
    error, sigma = found.pixels - truth, np.sqrt(np.diag(found.covariance))
    assert (np.abs(error) <= SIGMAS * sigma).all()
    assert np.hypot(*error) <= 0.03 + RELATIVE * length
    assert sigma.max() <= 0.03 + RELATIVE * length


def test_a_larger_movement_is_refused_with_camera_pixels_and_advice():
    entries, layouts = reference()
    with pytest.raises(InputError, match=r"movement in camera A: 0\.4\d \+- 0\.0\d px.*at most 0\.2 px: keep part and"):
        check(moved(entries, 0.05, (0.36, 0.27)), layouts)


def test_a_movement_of_several_pixels_is_refused():
    entries, layouts = reference()
    with pytest.raises(InputError, match=r"movement in camera A: [34]\.\d+ "):
        check(moved(entries, 0.05, (4.0, 0.0)), layouts)


def test_a_part_that_moves_before_a_still_background_is_found():
    entries, layouts = reference()
    fine = texture(0.05)
    before, after = picture(fine), picture(fine)
    after[100:260, 150:320] = picture(fine, (0.5, 0.0))[100:260, 150:320]
    images = sequence(entries, [before if k < 6 else after for k in range(len(entries))])
    with pytest.raises(InputError, match="around pixel"):
        check(images, layouts)


def test_without_texture_movement_is_not_observable():
    entries, layouts = reference()
    findings = check(moved(entries, 0.0, (0.5, 0.0)), layouts)
    assert [finding.value for finding in findings] == [None, None, None]
    assert "no texture" in findings[0].source


@pytest.mark.parametrize(
    "light",
    [
        {"gamma": 2.2},
        {"gains": [1 + 0.02 * (-1) ** k for k in range(13)]},
        {"gains": [0.9 + 0.008 * k for k in range(13)]},
    ],
    ids=["gamma", "flicker", "warming up"],
)
@pytest.mark.parametrize("steps", [3, 4])
def test_light_is_not_taken_for_movement(light, steps):
    entries, layouts = reference(steps)
    count = len(entries)
    options = {key: value[:count] if isinstance(value, list) else value for key, value in light.items()}
    first = check(moved(entries, 0.05, (0.0, 0.0), **options), layouts)[0]
    assert first.value is not None
    assert first.value <= SIGMAS * first.sigma + 0.01


def test_a_steady_movement_shows_in_the_fit_residual():
    made = manifest(phase_entries([1280], 12), projector_px=[1280, 800])
    layouts = read_layouts(made, "capture.json")
    fine = texture(0.05)
    images = sequence(made.sequence, [picture(fine, (0.15 * k / 11, 0.0)) for k in range(12)])
    found = drift(images, layouts[0].periods[0], True, NOISE, 255.0, 2).everywhere
    assert np.abs(found.pixels - (0.15, 0.0)).max() <= 0.02


def test_gray_bits_are_compared_in_their_lit_cells():
    entries = [*gray_entries(6, 20.0), *phase_entries([20], 4)]
    made = manifest(entries, projector_px=[1280, 800])
    layouts = read_layouts(made, "capture.json")
    pairs = to_compare(stills(layouts))
    assert pairs[0][0].lit_only
    fine = texture(0.05)
    images = sequence(made.sequence, [picture(fine, (0.0, 0.0) if k < 6 else (0.2, 0.1)) for k in range(10)])
    found = compare(images, *pairs[0], NOISE, 255.0, 2).everywhere
    assert np.abs(found.pixels - (0.2, 0.1)).max() <= 0.04
