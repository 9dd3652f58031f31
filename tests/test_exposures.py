"""Bracketed exposures: split, observed each, merged per pixel; against the truth of a shining plate."""

from dataclasses import replace

import numpy as np
import pytest

from planish.errors import InputError
from planish.measurement import NoiseModel, View, rejection_bit
from planish.pipeline import measure
from planish.sensing.capture.manifest import Capture
from planish.sensing.decode import PhaseMap
from planish.sensing.exposures import merge_exposures, merge_positions, merge_views, split_exposures
from planish.sensing.observe import Observation
from planish.sensing.patterns.sequences import multi_frequency_sequence, with_exposures
from planish.simulation.highlights import with_highlights
from planish.simulation.render import trace_capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene
from sequences import manifest, phase_entries

SHAPE = (120, 160)
#: Robust spread of 19,200 pixels is known to 0.6 %, rms to 0.5 %: four times that.
STATISTICAL = 0.025


def positions(rng, sigma, truth, rejected=None):
    """A PhaseMap with noise of a known sigma (H, W) about the true positions."""
    noisy = (truth + sigma * rng.standard_normal(truth.shape)).astype(np.float32)
    sigma = np.broadcast_to(np.float32(sigma), truth.shape).copy()
    mask = np.zeros(truth.shape, np.uint16) if rejected is None else rejected
    return PhaseMap("u", np.where(mask == 0, noisy, np.float32(np.nan)), sigma, mask)


@pytest.fixture(scope="module")
def truth():
    return np.tile(np.linspace(100, 300, SHAPE[1]), (SHAPE[0], 1))


def test_positions_that_agree_are_averaged_and_sigma_says_how_well(truth):
    rng = np.random.default_rng(1)
    maps = [positions(rng, s, truth) for s in (0.03, 0.05, 0.2)]
    merged = merge_positions(maps)
    expected = (1 / 0.03**2 + 1 / 0.05**2 + 1 / 0.2**2) ** -0.5
    assert np.allclose(merged.sigma_px, expected, rtol=1e-5)
    normalised = (merged.position_px - truth) / merged.sigma_px
    assert normalised.std() == pytest.approx(1, abs=STATISTICAL)


def test_what_all_exposures_have_in_common_does_not_average_out(truth):
    rng = np.random.default_rng(8)
    common = 0.03 * rng.standard_normal(truth.shape)
    each = [positions(rng, 0.04, truth + common) for _ in range(2)]
    merged = merge_positions([replace(m, sigma_px=np.full_like(m.sigma_px, 0.05)) for m in each])
    # Of 0.05 px, 0.04 are independent: sqrt(0.04^2 / 2 + 0.03^2) are left; some thousand differences tell the share.
    assert np.median(merged.sigma_px) == pytest.approx(0.0412, rel=0.03)
    assert np.std(merged.position_px - truth) == pytest.approx(np.median(merged.sigma_px), rel=0.04)


def test_a_wrong_whole_period_of_the_worse_exposure_changes_nothing(truth):
    rng = np.random.default_rng(2)
    good, bad = positions(rng, 0.03, truth), positions(rng, 0.1, truth + 20)
    merged = merge_positions([bad, good])
    assert np.array_equal(merged.position_px, good.position_px)
    # One over the root of one over the square, in float32.
    assert np.allclose(merged.sigma_px, good.sigma_px, rtol=1e-6)


def test_a_pixel_without_position_in_one_exposure_is_taken_from_the_other(truth):
    rng = np.random.default_rng(3)
    saturated = np.where(truth < 150, rejection_bit("saturated"), np.uint16(0))
    dark = np.where(truth > 250, rejection_bit("dark"), np.uint16(0))
    long, short = positions(rng, 0.03, truth, saturated), positions(rng, 0.1, truth, dark)
    merged = merge_positions([long, short])
    assert not merged.rejected.any()
    assert np.array_equal(merged.position_px[saturated > 0], short.position_px[saturated > 0])
    assert np.array_equal(merged.position_px[dark > 0], long.position_px[dark > 0])


def test_a_pixel_that_all_exposures_reject_keeps_the_reason_of_the_one_that_came_furthest(truth):
    rng = np.random.default_rng(4)
    bits = [np.full(SHAPE, rejection_bit(r), np.uint16) for r in ("saturated", "slip", "dark")]
    bits[1] |= rejection_bit("mixed")
    merged = merge_positions([positions(rng, 0.1, truth, b) for b in bits])
    assert np.all(merged.rejected == rejection_bit("slip") | rejection_bit("mixed"))
    assert np.isnan(merged.position_px).all()
    assert np.isnan(merged.sigma_px).all()


def views(light, gain=4.0, black=5.0, noise=(1.5, 0.025), seed=5):
    """Views of a long and a short exposure of `light` (H, W) [grey levels of the long one], 12 fringe images each."""
    rng, out = np.random.default_rng(seed), []
    for scale in (1.0, 1 / gain):
        level = black + 0.5 * light * scale
        variance = noise[0] + noise[1] * level
        mean = level + rng.standard_normal(light.shape) * np.sqrt(variance / 12)
        amplitude = 0.5 * light * scale + rng.standard_normal(light.shape) * np.sqrt(variance / 6)
        white = light * scale + rng.standard_normal(light.shape) * np.sqrt(2 * variance)
        white = np.minimum(white, 255 - black)
        maps = (m.astype(np.float32) for m in (white, mean, amplitude))
        out.append(View(*maps, 12, NoiseModel(*noise), 255.0))
    return out


def test_the_texture_is_on_the_scale_of_the_longest_exposure_without_a_step_where_it_saturates():
    light = np.tile(np.linspace(20, 800, 400), (480, 1))
    long, short = views(light)
    clipped = light + 5 > 245
    merged = merge_views([long, short], [clipped, np.zeros_like(clipped)], [20.0, 5.0])
    assert merged.saturation == pytest.approx(4 * 250 + 5, rel=0.01)
    for name, expected in (("mean", 5 + 0.5 * light), ("white", light), ("modulation", 0.5 * light)):
        error = getattr(merged, name) - expected
        below, above = (error[:, columns].mean() for columns in (slice(90, 110), slice(130, 150)))
        # The ratio of the exposures is known to 3 % per pixel of the short one, here from 14,000: 0.03 % of 270.
        assert abs(above - below) < 0.3


def test_the_noise_of_the_merged_texture_is_that_of_its_model_within_the_stated_approximation():
    # One pixel in twenty beyond the range of the long exposure, as highlights are.
    light = np.tile(np.concatenate([np.linspace(20, 235, 380), np.linspace(245, 800, 20)]), (300, 1))
    clipped = light + 5 > 245
    merged = merge_views(views(light), [clipped, np.zeros_like(clipped)], [20.0, 5.0])
    error = merged.mean - (5 + 0.5 * light)
    normalised = error / np.sqrt(merged.noise.variance(merged.mean) / merged.mean_images)
    dark, bright, beyond = (normalised[:, c].std() for c in (slice(0, 190), slice(190, 370), slice(380, 400)))
    # The line follows the many; beyond the long exposure's range the variance is over ten times as large.
    assert dark == pytest.approx(1, abs=0.15)
    assert bright == pytest.approx(1, abs=0.15)
    assert 1 < beyond < 3


def test_exposure_times_that_are_not_kept_are_found_from_the_amplitudes():
    light = np.tile(np.linspace(20, 200, 400), (120, 1))
    nowhere = np.zeros(light.shape, bool)
    merged = merge_views(views(light, gain=3.6), [nowhere, nowhere], [20.0, 5.0])
    assert np.abs((merged.mean - 5 - 0.5 * light).mean()) < 0.05


def test_patterns_without_positions_cannot_be_merged(truth):
    long, short = (Observation({}, view) for view in views(truth))
    with pytest.raises(InputError, match="give no position"):
        merge_exposures([long, short], [20.0, 5.0])


def test_a_capture_is_split_into_one_per_exposure_from_the_longest(tmp_path):
    entries = [e | {"exposure_ms": t} for t in (5, 20) for e in phase_entries([40])]
    capture = Capture("part", tmp_path / "capture.json", tmp_path, manifest(entries))
    parts = split_exposures(capture)
    assert [t for t, _ in parts] == [20, 5]
    assert [part.manifest.images.A for _, part in parts] == [
        [f"A_{k:02d}.png" for k in range(4, 8)],
        [f"A_{k:02d}.png" for k in range(4)],
    ]
    assert all(e.exposure_ms == 5 for e in parts[1][1].manifest.sequence)


@pytest.fixture(scope="module")
def shining(tmp_path_factory):
    """A plate whose highlights saturate 12 % of the pixels: (scene, long exposure only, both) as measurements."""
    scene = with_highlights(make_scene("plate", 3, 1, scale=0.3), 0.12)
    entries = multi_frequency_sequence()
    out = [scene]
    for sequence in (entries, with_exposures(entries, [5.0, 20.0])):
        folder = tmp_path_factory.mktemp("shining")
        write_scene(replace(scene, sequence=tuple(sequence)), folder, true_points=False)
        out.append(measure(Capture.load(folder / "m1")))
    return out


def normalised_errors(item, scene):
    truth, seen = trace_capture(scene, 0, "A")
    both = item.valid & np.isfinite(truth[..., 2])
    ray = truth[both] - item.camera.center_sensor
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return ((item.points_sensor[both] - truth[both]) * ray).sum(1) / item.sigma_mm[both], item.valid[seen].mean()


def test_highlights_are_recovered_and_sigma_stays_honest(shining):
    scene, single, both = shining
    saturated = rejection_bit("saturated")
    assert (single.rejected & saturated > 0).mean() > 0.03
    assert not (both.rejected & saturated).any()
    error, share = normalised_errors(both, scene)
    assert share > 0.99
    assert np.sqrt(np.mean(error**2)) == pytest.approx(1, abs=0.05)
    assert np.abs(error).max() < 8
    recovered = both.valid & ~single.valid
    full = np.full(both.shape, np.nan)
    truth = trace_capture(scene, 0, "A")[0]
    full[both.valid & np.isfinite(truth[..., 2])] = error
    assert np.nanstd(full[recovered]) == pytest.approx(1, abs=0.1)


def test_two_exposures_know_more_than_one(shining):
    _, single, both = shining
    known = single.valid & both.valid
    assert np.median(both.sigma_mm[known]) < 0.99 * np.median(single.sigma_mm[known])


def test_the_texture_of_highlights_goes_beyond_the_range_of_one_image(shining):
    _, single, both = shining
    white = both.views["A"].white
    assert single.views["A"].white.max() <= 255
    assert white.max() > 260
    assert np.isfinite(white).all()
    below = single.views["A"].white < 200
    difference = (white - single.views["A"].white)[below & both.valid]
    # The white image of one exposure has a noise of about 3 grey levels, two of them a little less.
    assert abs(np.median(difference)) < 0.3
    assert both.views["A"].saturation > 900
