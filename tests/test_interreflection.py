"""Light that comes by two ways: found where coarse and fine fringes disagree, and nowhere else."""

import numpy as np
import pytest

from planish.measurement import REJECTIONS, NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.decode import DecodeOptions
from planish.sensing.observe import observe
from planish.sensing.patterns.sequences import encode
from sequences import manifest, phase_entries, render

NOISE = NoiseModel(1.5, 0.025)
SHAPE = (240, 900)
#: Of the pixels of a clean capture.
MAX_FALSE_ALARMS = 1e-4


def positions():
    return np.tile(np.linspace(5, 1270, SHAPE[1]), (SHAPE[0], 1)) + np.linspace(0, 0.9, SHAPE[0])[:, None]


def noisy(grey, rng):
    grey = grey + rng.standard_normal(grey.shape) * np.sqrt(NOISE.offset + NOISE.slope * grey)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def images_with(share, gamma=1.0, steps=4, periods=(1280, 160, 20)):
    """Images where a second way brings `share` (H, W) of the light, blurred over 60 px, from 150 px beside."""
    plan = manifest(phase_entries(periods, steps), projector_px=(1280, 800))
    rng, x, images = np.random.default_rng(2), positions(), []
    albedo = np.linspace(0.5, 1.0, SHAPE[0])[:, None]
    for entry in plan.sequence:
        spread = np.mean([encode(entry, x + 150 + shift) for shift in np.linspace(-30, 30, 13)], axis=0)
        light = (1 - share) * encode(entry, x) ** gamma + share * spread**gamma
        images.append(noisy(10 + 180 * albedo * light, rng))
    return images, plan


def rejected(images, plan, reason="interreflection"):
    (layout,) = read_layouts(plan, "test")
    seen = observe({"A": images}.__getitem__, ("A",), layout, DecodeOptions(), "test", 2)["A"]
    return (seen.phases["u"].rejected >> REJECTIONS.index(reason)) & 1 == 1


def test_an_area_lit_by_two_ways_is_rejected_and_its_surroundings_are_not():
    share = np.zeros(SHAPE)
    share[60:180, 300:500] = 0.15
    found = rejected(*images_with(share))
    # Where the second way's phase is opposite, the shift of a long fringe crosses zero: some is never seen.
    assert found[65:175, 305:495].mean() > 0.7
    outside = share == 0
    assert found[outside].mean() < MAX_FALSE_ALARMS


@pytest.mark.parametrize(("gamma", "steps"), [(1.0, 4), (2.2, 4), (2.2, 3), (2.2, 5), (1.0, 3)])
def test_clean_captures_and_those_with_a_gamma_are_not_suspected(gamma, steps):
    assert rejected(*images_with(np.zeros(SHAPE), gamma, steps)).mean() < MAX_FALSE_ALARMS


def test_beats_are_compared_like_periods():
    clean, plan = images_with(np.zeros(SHAPE), periods=(28, 26, 24))
    assert rejected(clean, plan).mean() < MAX_FALSE_ALARMS
    share = np.zeros(SHAPE)
    share[60:180, 300:500] = 0.2
    found = rejected(*images_with(share, periods=(1280, 28, 26)))
    assert found[65:175, 305:495].mean() > 0.5
    assert found[share == 0].mean() < MAX_FALSE_ALARMS


def test_a_single_pixel_that_disagrees_is_no_area():
    plan = manifest(phase_entries([1280, 160, 20]), projector_px=(1280, 800))
    x = positions()
    images = render(plan.sequence, x, noise=(NOISE.offset, NOISE.slope))
    moved = x.copy()
    moved[100, 300:303] += 30
    for k, image in enumerate(render(plan.sequence[:4], moved)):
        images[k][100, 300:303] = image[100, 300:303]
    assert not rejected(images, plan)[95:105, 295:305].any()
