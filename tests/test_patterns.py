import numpy as np
import pytest

from planish.errors import InputError
from planish.sensing.entries import Black, Gray, Phase, White
from planish.sensing.patterns import (
    encode,
    gray_phase_sequence,
    named_sequence,
    phase_steps,
    projector_image,
    projector_profile,
    reference_sequence,
)

#: Closed formulas in float64.
EXACT = 1e-12


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("period", "steps", "step"), [(20.0, 4, 1), (17.3, 5, 3), (1280.0, 3, 0)])
def test_a_phase_image_is_the_cosine_of_the_convention(sign, period, steps, step):
    entry = Phase(role="phase", period_px=period, step=step, steps=steps, sign=sign)
    u = np.linspace(-5, 1300, 777)
    expected = 0.5 + 0.5 * np.cos(2 * np.pi * u / period - sign * 2 * np.pi * step / steps)
    assert np.abs(encode(entry, u) - expected).max() < EXACT


def test_the_steps_of_a_sine_decode_to_its_phase():
    images = np.array([projector_profile(entry, (1280, 800)) for entry in phase_steps(20.0, 4)])
    angle = 2 * np.pi * np.arange(4) / 4
    phase = np.arctan2(np.sin(angle) @ images, np.cos(angle) @ images)
    difference = np.exp(1j * phase) / np.exp(2j * np.pi * np.arange(1280) / 20)
    assert np.abs(np.angle(difference)).max() < EXACT


def test_a_shifted_square_wave_decodes_without_bias():
    images = np.array([projector_profile(entry, (1280, 800)) for entry in phase_steps(16.0, 8, wave="square")])
    assert set(np.unique(images)) <= {0.0, 0.5, 1.0}
    angle = 2 * np.pi * np.arange(8) / 8
    phase = np.arctan2(np.sin(angle) @ images, np.cos(angle) @ images)
    error = np.angle(np.exp(1j * phase) / np.exp(2j * np.pi * np.arange(1280) / 16))
    assert abs(error.mean()) < EXACT
    # Third harmonics stay in eight steps: the error of a square wave is below pi / 24 of a period's radians.
    assert np.abs(error).max() < np.pi / 24


def test_neighbouring_gray_cells_differ_in_one_bit_and_decode_to_the_cell():
    bits = np.array(
        [projector_profile(Gray(role="gray", bit=b, cell_px=10), (1280, 800)) for b in range(7)], dtype=int
    )  # fmt: skip
    change = np.abs(np.diff(bits, axis=1)).sum(0)
    assert set(change[9::10]) == {1}
    assert change.sum() == 127
    code = (bits * 2 ** np.arange(7)[:, None]).sum(0)
    cell = code.copy()
    for shift in (1, 2, 4):
        cell ^= cell >> shift
    assert np.array_equal(cell, np.arange(1280) // 10)


def test_the_inverse_of_a_gray_bit_is_its_complement():
    u = np.arange(1280)
    plain, inverse = (encode(Gray(role="gray", bit=3, inverse=i), u) for i in (False, True))
    assert np.array_equal(plain + inverse, np.ones(1280))


def test_the_reference_sequence_has_twelve_fringe_images_white_and_black():
    entries = reference_sequence()
    assert [(e.period_px, e.step, e.steps) for e in entries[:12]] == [
        (period, step, 4) for period in (1280, 160, 20) for step in range(4)
    ]
    assert [type(e) for e in entries[12:]] == [White, Black]
    assert projector_profile(entries[12], (1280, 800)).min() == 1
    assert projector_profile(entries[13], (1280, 800)).max() == 0


def test_the_gray_sequence_tells_all_periods_apart():
    entries = [e for e in gray_phase_sequence((1280, 800), period_px=20.0) if isinstance(e, Gray)]
    words = np.array([projector_profile(e, (1280, 800)) for e in entries]).T
    assert len(np.unique(words, axis=0)) == 128


def test_an_entry_along_v_varies_over_the_rows():
    entry = Phase(role="phase", axis="v", period_px=20, step=0, steps=4)
    image = projector_image(entry, (64, 40))
    assert image.shape == (40, 64)
    assert np.ptp(image, axis=1).max() == 0
    assert np.ptp(image[:, 0]) > 0.9


def test_an_unknown_sequence_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match="reference, phase-shift"):
        named_sequence("rainbow")
