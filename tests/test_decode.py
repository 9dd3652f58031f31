"""Decoding: absolute positions from fringes and Gray code, their sigma, and what is rejected."""

import numpy as np
import pytest

from planish import _core
from planish.measurement import REJECTIONS, NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.decode import DecodeOptions, decode
from planish.sensing.observe import observe
from reference import sensing as reference
from sequences import gray_entries, manifest, phase_entries, render

#: Half a grey level of rounding in each of 4 steps at its worst, at an amplitude of 80 [projector px]:
#: 2 / 4 * 0.5 * (|sin| + |cos| of four steps: 2 sqrt 2) / 80 * 20 / 2 pi.
ROUNDING_PX = 0.0285
#: Half a level in 256 more levels.
ROUNDING_16_BIT_PX = ROUNDING_PX / 256
QUIET = NoiseModel(0.1, 0.0)


def ramp(shape=(40, 640), start=0.0, end=1278.0):
    """Positions that rise along the row, with the rows shifted against each other."""
    return np.linspace(start, end, shape[1])[None, :] + np.linspace(0, 0.9, shape[0])[:, None]


def layout_of(plan):
    (layout,) = read_layouts(plan, "test")
    return layout


def observed(images, plan):
    """What camera A saw, of the one axis that the sequence encodes."""
    seen = observe({"A": images}.__getitem__, ("A",), layout_of(plan), DecodeOptions(), "test", 2)["A"]
    (phase,) = seen.phases.values()
    return phase, seen.view


def decoded(entries, positions, model=QUIET, coarse=None, bits=8, projector=(1280, 800), **more):
    plan = manifest(entries, projector_px=projector)
    images = render(plan.sequence, positions, bits=bits, **more)
    saturation = 255.0 if bits == 8 else 65535.0
    return decode(images, layout_of(plan).codes[0], model, saturation, DecodeOptions(), 2, coarse)[0]


def rejected_for(result, reason):
    return (result.rejected >> REJECTIONS.index(reason)) & 1 == 1


@pytest.mark.parametrize(("bits", "tolerance"), [(8, ROUNDING_PX), (16, 2 * ROUNDING_16_BIT_PX)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_hierarchy_of_periods_gives_the_absolute_position(bits, tolerance, sign):
    positions = ramp()
    result = decoded(phase_entries([1280, 160, 20], sign=sign), positions, bits=bits)
    # Single precision at 1280 px.
    assert np.abs(result.position_px - positions).max() < tolerance + 1.3e-4
    assert not result.rejected.any()


def test_positions_just_outside_the_first_and_last_pixel_keep_their_side():
    positions = np.concatenate([np.full((5, 30), -0.4), np.full((5, 30), 1279.4)], axis=1)
    result = decoded(phase_entries([1280, 160, 20]), positions, bits=16)
    assert np.abs(result.position_px - positions).max() < 1e-3


def test_the_kernel_equals_its_numpy_twin():
    entries = phase_entries([1280, 160, 20], steps=5)
    plan = manifest(entries, projector_px=(1280, 800))
    layout = layout_of(plan)
    images = render(plan.sequence, ramp(start=50.0, end=1200.0), noise=(1.0, 0.02))
    found = decode(images, layout.codes[0], NoiseModel(1.0, 0.02), 255.0, DecodeOptions(), 2)[0].position_px
    stacks = [np.stack([images[i] for i in p.images]) for p in layout.periods]
    expected = reference.decode(
        stacks, [p.angles for p in layout.periods], [p.period_px for p in layout.periods], start=-0.5
    )
    # 1e-6 rad of the arc tangent over 20 px, and single precision at 1280 px.
    assert np.abs(found - expected).max() < 20 / (2 * np.pi) * 1e-6 + 2.5e-4


def test_sigma_is_the_standard_deviation_of_the_position():
    positions = ramp((200, 640))
    noise = NoiseModel(1.5, 0.025)
    result = decoded(phase_entries([1280, 160, 20]), positions, noise, noise=(noise.offset, noise.slope))
    normalised = (result.position_px - positions) / result.sigma_px
    # 128,000 samples: one per cent is five standard errors; rounding adds 1/12 to a variance of 4.5.
    assert 0.98 < np.nanstd(normalised) < 1.03


@pytest.mark.parametrize("inverse", [False, True])
def test_gray_code_with_cells_of_half_a_period_counts_the_fringes(inverse):
    positions = ramp(end=1270.0)
    entries = phase_entries([20], steps=6) + gray_entries(7, 10, inverse)
    if not inverse:
        entries += [{"role": "white"}, {"role": "black"}]
    plan = manifest(entries, projector_px=(1280, 800))
    images = render(plan.sequence, positions)
    result, _ = observed(images, plan)
    assert np.abs(result.position_px - positions).max() < ROUNDING_PX


def test_gray_code_without_white_is_compared_with_the_mean_of_the_fringes():
    positions = ramp(end=1270.0)
    plan = manifest(phase_entries([20], steps=12, sign=-1) + gray_entries(7, 10))
    images = render(plan.sequence, positions)
    result, view = observed(images, plan)
    assert np.abs(result.position_px - positions).max() < ROUNDING_PX
    assert view.white is None
    assert view.mean_images == 12


def test_fringes_that_start_elsewhere_than_the_cells_are_counted_right():
    """Some sequences start a fringe at a cell's border: the constant is found, and no position slips."""
    positions = ramp(end=1250.0)
    plan = manifest(phase_entries([20], steps=6) + gray_entries(7, 10) + [{"role": "white"}, {"role": "black"}])
    shifted = render(plan.sequence[:6], positions - 5.3) + render(plan.sequence[6:], positions)
    result, _ = observed(shifted, plan)
    assert np.abs(result.position_px - (positions - 5.3)).max() < ROUNDING_PX


def test_square_waves_are_read_as_phase_steps():
    positions = ramp((8, 640), 100, 300)
    plan = manifest(phase_entries([16], steps=8, wave="square") + gray_entries(7, 8))
    images = render(plan.sequence, positions)
    result, _ = observed(images, plan)
    # Eight steps of a square wave leave harmonics 7 and 9: half a step, 16 / 8 / 2 = 1 px, at the very most.
    assert np.nanmax(np.abs(result.position_px - positions)) < 1.0
    assert np.isfinite(result.position_px).mean() > 0.99


def test_gray_cells_equal_their_numpy_twin():
    cells = np.random.default_rng(1).integers(0, 512, (30, 50))
    gray = cells ^ (cells >> 1)
    bits = [((gray >> b) & 1 == 1) for b in reversed(range(9))]
    images = [np.where(bit, 90, 30).astype(np.uint8) for bit in bits]
    found = _core.decode_gray(images, [-1] * 9, np.full(cells.shape, 60, np.float32), 2)
    assert np.array_equal(found, cells)
    assert np.array_equal(found, reference.gray_cells(np.array(bits)))


def test_saturated_steps_are_left_out():
    positions = ramp((20, 640))
    entries = phase_entries([1280, 160, 20], steps=6)
    result = decoded(entries, positions, offset=40, amplitude=240)
    # Of 6 steps one or two are lost; the worst geometry of four steps doubles the error of rounding.
    assert np.nanmax(np.abs(result.position_px - positions)) < 2 * ROUNDING_PX
    assert not result.rejected.any()


def test_pixels_with_fewer_than_three_good_steps_are_rejected_as_saturated():
    result = decoded(phase_entries([1280, 160, 20], steps=3), ramp((20, 640)), offset=40, amplitude=240)
    saturated = rejected_for(result, "saturated")
    assert saturated.any()
    assert np.isnan(result.position_px[saturated]).all()


def test_pixels_without_fringes_are_rejected_as_dark():
    result = decoded(phase_entries([1280, 160, 20]), ramp(), NoiseModel(1.0, 0.02), amplitude=1.0, noise=(1.0, 0.02))
    assert rejected_for(result, "dark").mean() > 0.99


def test_contradicting_periods_are_rejected_as_slips():
    positions = ramp()
    plan = manifest(phase_entries([1280, 160, 20]), projector_px=(1280, 800))
    moved = positions.copy()
    moved[:, 300:340] += 80
    images = render(plan.sequence[:4], positions) + render(plan.sequence[4:8], moved)
    images += render(plan.sequence[8:], positions)
    result, *_ = decode(images, layout_of(plan).codes[0], QUIET, 255.0, DecodeOptions(), 2)
    assert rejected_for(result, "slip")[:, 300:340].mean() > 0.95
    assert not result.rejected[:, :295].any()


def test_a_single_slipped_pixel_takes_the_periods_of_its_neighbours_and_keeps_its_phase():
    positions = ramp((20, 640), 0, 600)
    plan = manifest(phase_entries([1280, 160, 20]), projector_px=(1280, 800))
    images = render(plan.sequence, positions)
    slipped = positions.copy()
    slipped[10, 200] += 160
    # Only the coarsest period is wrong there, as from a speck of dirt.
    for k, image in enumerate(render(plan.sequence[:4], slipped)):
        images[k] = image
    result, *_ = decode(images, layout_of(plan).codes[0], QUIET, 255.0, DecodeOptions(), 2)
    assert abs(result.position_px[10, 200] - positions[10, 200]) < ROUNDING_PX
    assert not result.rejected.any()


def test_the_result_does_not_depend_on_the_number_of_threads():
    plan = manifest(phase_entries([1280, 160, 20]), projector_px=(1280, 800))
    images = render(plan.sequence, ramp((37, 640)), noise=(1.0, 0.02))
    results = [
        decode(images, layout_of(plan).codes[0], NoiseModel(1.0, 0.02), 255.0, DecodeOptions(), n)[0] for n in (1, 2, 7)
    ]
    for other in results[1:]:
        assert results[0].position_px.tobytes() == other.position_px.tobytes()
        assert results[0].sigma_px.tobytes() == other.sigma_px.tobytes()


def test_sigma_is_right_for_three_steps_and_where_steps_are_saturated():
    positions = ramp((200, 640))
    noise = NoiseModel(1.5, 0.025)
    for steps, amplitude, least in ((3, 160.0, 0.999), (6, 235.0, 0.9)):
        result = decoded(
            phase_entries([1280, 160, 20], steps=steps), positions, noise, noise=(1.5, 0.025), amplitude=amplitude
        )
        normalised = (result.position_px - positions) / result.sigma_px
        valid = result.rejected == 0
        assert valid.mean() > least
        phase = 2 * np.pi * positions / 20
        for part in range(6):
            # 20,000 samples in each sixth of a period: five per cent are ten standard errors.
            members = valid & (np.floor(phase * 6 / (2 * np.pi)) % 6 == part)
            assert np.std(normalised[members]) == pytest.approx(1, abs=0.05)


def test_a_slipped_pixel_at_a_border_with_few_neighbours_is_rejected():
    positions = ramp((20, 640), 0, 600)
    plan = manifest(phase_entries([1280, 160, 20]), projector_px=(1280, 800))
    images = render(plan.sequence, positions)
    slipped = positions.copy()
    slipped[0, 639] += 160
    for k, image in enumerate(render(plan.sequence[:4], slipped)):
        images[k] = image
    result, *_ = decode(images, layout_of(plan).codes[0], QUIET, 255.0, DecodeOptions(), 2)
    # Three neighbours contradict it, too few to correct it.
    assert rejected_for(result, "slip")[0, 639]
    assert np.isnan(result.position_px[0, 639])
    assert result.rejected.astype(bool).sum() == 1
