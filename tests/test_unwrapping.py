"""The ladder from coarse to fine: which levels it takes, and that any set of periods is decoded by it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planish.errors import InputError
from planish.measurement import NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.capture.unwrapping import SLIP_SIGMAS, candidates, plan_levels
from planish.sensing.decode import DecodeOptions, decode
from planish.sensing.observe import observe
from sequences import gray_entries, manifest, phase_entries, render

#: Rounding of 16 bit and single precision at 2000 px, in projector px.
EXACT_PX = 1e-3
QUIET = NoiseModel(20.0, 0.0)


def names(ladder):
    return [(level.coefficients, round(level.period_px, 3)) for level in ladder.levels]


def decoded(entries, positions, model=QUIET, order=None, bits=16, projector=None, **more):
    """Positions, sigma and rejections by a sequence, whose images stand in a given order."""
    entries = [entries[i] for i in order] if order is not None else entries
    plan = manifest(entries, **({} if projector is None else {"projector_px": projector}))
    images = render(plan.sequence, positions, bits=bits, **more)
    (layout,) = read_layouts(plan, "test")
    return decode(images, layout.codes[0], model, 255.0 if bits == 8 else 65535.0, DecodeOptions(), 2)[0]


def test_a_hierarchy_is_climbed_period_by_period():
    ladder = plan_levels([1280, 160, 20], [4, 4, 4], 1280)
    assert names(ladder) == [((1, 0, 0), 1280), ((0, 1, 0), 160), ((0, 0, 1), 20)]
    assert ladder.averaged == (2,)


def test_close_periods_are_told_apart_by_their_beats_and_beats_of_beats():
    ladder = plan_levels([28, 26, 24], [4, 4, 4], 1280)
    assert names(ladder)[0] == ((1, -2, 1), 2184)
    assert names(ladder)[-1] == ((0, 0, 1), 24)
    assert ladder.averaged == (0, 1, 2)


def test_without_a_known_extent_the_longest_period_or_beat_is_absolute():
    assert names(plan_levels([21, 18], [4, 4]))[0] == ((-1, 1), 126)
    assert names(plan_levels([1000, 150, 20], [4, 4, 4]))[0] == ((1, 0, 0), 1000)


def test_beside_a_gray_code_no_period_need_be_long():
    assert names(plan_levels([20], [6], 1280, 10)) == [((1,), 20)]
    assert names(plan_levels([21, 18], [4, 4], 1280, 60)) == [((-1, 1), 126), ((0, 1), 18)]


def test_the_noise_limit_is_where_half_a_period_holds_the_wanted_sigmas():
    ladder = plan_levels([1280, 160], [4, 6], 1280)
    sigma = math.hypot(1280 * math.sqrt(2 / 4), 160 * math.sqrt(2 / 6)) / (2 * math.pi)
    assert ladder.noise_limit == pytest.approx(80 / sigma / SLIP_SIGMAS)


def test_no_level_is_a_mere_multiple_of_another():
    assert all(math.gcd(*level.coefficients) == 1 for level in candidates([100, 60, 45]))


@pytest.mark.parametrize(
    ("sequence", "message"),
    [
        (phase_entries([21, 18]), r"longest period is the beat of 126 px of 1280 projector px"),
        (phase_entries([1280, 5]), r"1280 px to 5 px needs noise below 0\.4% of the amplitude"),
        (phase_entries([21, 18]) + gray_entries(3, 200), "longer than the longest period"),
    ],
)
def test_periods_that_do_not_tell_the_fringes_apart_are_refused(sequence, message):
    with pytest.raises(InputError, match=message):
        read_layouts(manifest(sequence, projector_px=(1280, 800)), "m")


def surface(seed, extent):
    """Positions (8, 300) of a tilted plane, rising or falling, that lie inside the projector."""
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(0, extent - 1, 2)
    return np.clip(np.linspace(start, end, 300) + np.linspace(0, rng.uniform(-2, 2), 8)[:, None], 0, extent - 1)


LADDERS = st.sampled_from(
    [
        ((1280.0, 160.0, 20.0), 1280),
        ((2000.0, 130.0, 17.3), 1280),
        ((28.0, 26.0, 24.0), 1280),
        ((21.0, 18.0), 120),
        ((64.0, 60.0, 9.0), 900),
        ((900.0, 90.0, 81.0, 10.0), 800),
    ]
)


@settings(max_examples=25, deadline=None)
@given(
    ladder=LADDERS,
    steps=st.lists(st.integers(3, 13), min_size=4, max_size=4),
    sign=st.sampled_from([1, -1]),
    seed=st.integers(0, 1000),
)
def test_decoding_undoes_encoding_for_any_periods_steps_order_and_sign(ladder, steps, sign, seed):
    periods, extent = ladder
    entries = [e for p, n in zip(periods, steps, strict=False) for e in phase_entries([p], n, sign)]
    positions = surface(seed, extent)
    order = np.random.default_rng(seed).permutation(len(entries))
    found = decoded(entries, positions, order=order, projector=(extent, 800))
    assert not found.rejected.any()
    assert np.abs(found.position_px - positions).max() < EXACT_PX


@settings(max_examples=15, deadline=None)
@given(scale=st.floats(0.3, 1.0), offset=st.floats(0.0, 60.0), seed=st.integers(0, 100))
def test_brightness_and_offset_change_nothing_beyond_rounding(scale, offset, seed):
    positions = surface(seed, 1280)
    entries = phase_entries([1280, 160, 20])
    found = decoded(entries, positions, projector=(1280, 800), offset=offset, amplitude=190 * scale)
    assert np.abs(found.position_px - positions).max() < EXACT_PX


def test_the_declared_order_of_the_images_changes_no_byte():
    positions = np.tile(np.linspace(0, 1279, 400), (30, 1))
    entries = phase_entries([1280, 160, 20], steps=5)
    images = render(manifest(entries).sequence, positions, noise=(1.0, 0.02))
    found = []
    for order in (np.arange(15), np.random.default_rng(1).permutation(15)):
        plan = manifest([entries[i] for i in order], projector_px=(1280, 800))
        code = read_layouts(plan, "test")[0].codes[0]
        result = decode([images[i] for i in order], code, NoiseModel(1.0, 0.02), 255.0, DecodeOptions(), 2)
        found.append(b"".join(a.tobytes() for a in (result[0].position_px, result[0].sigma_px, *result[1:])))
    assert found[0] == found[1]


def test_close_periods_of_equal_quality_are_averaged_by_their_information():
    noise = NoiseModel(1.5, 0.025)
    positions = np.tile(np.linspace(0, 1279, 800), (160, 1)) + np.linspace(0, 30, 160)[:, None]
    found = decoded(
        phase_entries([28, 26, 24]), positions, noise, bits=8, projector=(1320, 800), noise=(noise.offset, noise.slope)
    )
    one = decoded(phase_entries([1320, 160, 24]), positions, noise, bits=8, noise=(noise.offset, noise.slope))
    # 1 / (1/24^2 + 1/26^2 + 1/28^2) over 24^2; the first set adds nothing to its finest period.
    expected = math.sqrt(1 / (1 + (24 / 26) ** 2 + (24 / 28) ** 2))
    assert np.nanmedian(found.sigma_px) / np.nanmedian(one.sigma_px) == pytest.approx(expected, rel=0.01)
    # 128,000 samples: three per cent are fifteen standard errors; rounding adds 1/12 to a variance of 4.5.
    assert np.nanstd((found.position_px - positions) / found.sigma_px) == pytest.approx(1, abs=0.03)
    assert (found.rejected == 0).mean() > 0.999


@pytest.mark.parametrize("cell", [10, 60])
def test_several_periods_above_a_gray_code_are_decoded(cell):
    positions = np.tile(np.linspace(0, 1270, 640), (40, 1))
    plan = manifest(phase_entries([21, 18]) + gray_entries(8, cell, inverse=True), projector_px=(1280, 800))
    images = render(plan.sequence, positions, bits=16)
    (layout,) = read_layouts(plan, "test")
    phase = observe({"A": images}.__getitem__, ("A",), layout, DecodeOptions(), "test", 2)["A"].phases["u"]
    assert (phase.rejected == 0).mean() > 0.99
    # The images are free of noise; what is left is the rounding of 16 bit.
    assert np.nanmax(np.abs(phase.position_px - positions)) < EXACT_PX


def test_a_gamma_that_shifts_coarse_fringes_by_more_than_a_slip_is_no_hindrance():
    positions = np.tile(np.linspace(1, 1278, 900), (60, 1)) + np.linspace(0, 0.9, 60)[:, None]
    plan = manifest(phase_entries([1280, 160, 20], steps=3), projector_px=(1280, 800))
    rng = np.random.default_rng(0)
    images = [
        np.clip(np.round(200 * (image / 65535) ** 2.2 + rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)
        for image in render(plan.sequence, positions, bits=16, offset=20, amplitude=235)
    ]
    code = read_layouts(plan, "test")[0].codes[0]
    found = decode(images, code, NoiseModel(1.0, 0.0), 255.0, DecodeOptions(), 2)[0]
    assert (found.rejected == 0).mean() > 0.99
    # The harmonics of the finest fringes stay: an eighth of a period at most. A slip would be a whole one.
    assert np.nanmax(np.abs(found.position_px - positions)) < 20 / 8
