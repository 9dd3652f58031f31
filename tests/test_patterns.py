import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planish.errors import InputError
from planish.sensing.patterns.entries import Black, Gray, Phase, White
from planish.sensing.patterns.sequences import (
    SEQUENCES,
    encode,
    gray_bits,
    gray_phase_sequence,
    gray_sequence,
    heterodyne_sequence,
    multi_frequency_sequence,
    named_sequence,
    pattern_image,
    phase_shift_sequence,
    phase_steps,
    projector_image,
    projector_profile,
    reference_sequence,
    with_exposures,
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


SIZES = st.tuples(st.integers(300, 4096), st.integers(300, 4096))
AXES = st.sampled_from([("u",), ("v",), ("u", "v")])


def extent_of(entry, size):
    return size[0] if entry.axis == "u" else size[1]


def gray_words(entries, extent):
    """Cell number (extent,) that the direct Gray images of one axis show at every projector pixel."""
    direct = [e for e in entries if isinstance(e, Gray) and not e.inverse]
    code = sum(encode(e, np.arange(extent)).astype(int) << e.bit for e in direct)
    cell = code.copy()
    for shift in (1, 2, 4, 8):
        cell ^= cell >> shift
    return cell


@pytest.mark.parametrize("name", SEQUENCES)
def test_every_coding_ends_with_white_and_black_and_names_its_axis(name):
    entries = named_sequence(name, (1280, 800), axes=("v",))
    assert [type(e) for e in entries[-2:]] == [White, Black]
    assert {e.axis for e in entries[:-2]} == {"v"}


@pytest.mark.parametrize("name", [name for name in SEQUENCES if name != "statistical"])
def test_both_axes_are_encoded_one_after_the_other(name):
    both = named_sequence(name, (1280, 800), axes=("u", "v"))
    single = [named_sequence(name, (1280, 800), axes=(axis,))[:-2] for axis in "uv"]
    assert both[:-2] == single[0] + single[1]


@given(name=st.sampled_from(sorted(SEQUENCES)), size=st.tuples(st.integers(240, 1280), st.integers(240, 1280)))
def test_every_pattern_is_in_range_at_any_coordinate(name, size):
    for entry in named_sequence(name, size):
        value = encode(entry, np.linspace(-3, max(size) + 3, 301))
        assert value.min() >= 0
        assert value.max() <= 1


@given(
    period=st.floats(3, 500), steps=st.integers(3, 12), sign=st.sampled_from([1, -1]), u=st.floats(0, 2000),
    whole=st.integers(-3, 3),
)  # fmt: skip
def test_phase_steps_are_periodic_and_decode_to_their_coordinate(period, steps, sign, u, whole):
    entries = phase_steps(period, steps, sign=sign)
    image, moved = (np.array([float(encode(e, x)) for e in entries]) for x in (u, u + whole * period))
    # Rounding of u / period, times 2 pi.
    assert np.abs(image - moved).max() < 1e-9
    angle = sign * 2 * np.pi * np.arange(steps) / steps
    phase = np.arctan2(np.sin(angle) @ image, np.cos(angle) @ image)
    error = np.angle(np.exp(1j * (phase - 2 * np.pi * u / period)))
    assert abs(error) < 1e-7


@given(size=SIZES, axes=AXES, period=st.floats(6, 60), ratio=st.floats(2, 16))
def test_a_hierarchy_covers_the_projector_and_ends_at_the_finest_period(size, axes, period, ratio):
    for axis in axes:
        entries = [e for e in multi_frequency_sequence(size, axes, period_px=period, ratio=ratio) if e.role == "phase"]
        periods = sorted({e.period_px for e in entries if e.axis == axis}, reverse=True)
        assert periods[0] > extent_of(entries[0] if axis == entries[0].axis else entries[-1], size)
        assert periods[-1] == period
        quotients = np.array(periods[:-1]) / periods[1:]
        # The spare of the longest period and the rounding of the others to whole pixels.
        assert quotients.max() < ratio * 1.2


@given(size=SIZES, count=st.sampled_from([2, 3]), axis=st.sampled_from("uv"))
def test_the_beats_of_heterodyne_periods_tell_every_place_of_the_projector_apart(size, count, axis):
    entries = [e for e in heterodyne_sequence(size, (axis,), count=count) if e.role == "phase"]
    periods = sorted({e.period_px for e in entries})
    assert len(periods) == count
    extent = extent_of(entries[0], size)
    longest = periods[0] * periods[1] / (periods[1] - periods[0])
    assert longest > extent
    # Halves of the spare before and after: nothing within the projector repeats.
    assert longest < 1.1 * extent + 1


@given(size=SIZES, cell=st.floats(1, 20), inverses=st.booleans())
def test_gray_bits_count_the_cells_of_any_projector(size, cell, inverses):
    bits = gray_bits(size[0], cell, inverses=inverses)
    assert np.array_equal(gray_words(bits, size[0]), np.floor(np.arange(size[0]) / cell))
    images = [encode(e, np.arange(size[0])) for e in bits]
    if inverses:
        assert all(np.array_equal(a + b, np.ones(size[0])) for a, b in zip(images[::2], images[1::2], strict=True))


@given(size=SIZES, period=st.floats(6, 60), complementary=st.booleans())
def test_gray_cells_are_whole_or_half_periods_and_count_them(size, period, complementary):
    entries = gray_phase_sequence(size, period_px=period, complementary=complementary)
    cell = period / 2 if complementary else period
    assert np.array_equal(gray_words(entries, size[0]), np.floor(np.arange(size[0]) / cell))


def test_without_inverses_the_gray_code_alone_has_half_the_images():
    assert len(gray_sequence(inverses=True)) - 2 == 2 * (len(gray_sequence(inverses=False)) - 2)


def test_statistical_patterns_differ_and_follow_from_their_seed():
    first, again, other = (
        [encode(e, np.arange(1280)) for e in named_sequence("statistical", count=4, seed=s)[:4]] for s in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    correlation = np.corrcoef(np.array([*first, *other]))
    # Independent stripes of about 60 periods each: 0.13 standard deviation.
    assert np.abs(correlation - np.eye(8)).max() < 0.6


def test_a_sequence_is_repeated_with_each_exposure():
    entries = with_exposures(reference_sequence(), [5, 20])
    assert [e.exposure_ms for e in entries] == [5] * 14 + [20] * 14
    assert [e.model_copy(update={"exposure_ms": None}) for e in entries[14:]] == reference_sequence()


def test_the_pattern_makes_up_for_the_gamma_of_the_projector():
    entry = Phase(role="phase", period_px=64, step=0, steps=4)
    shown = (pattern_image(entry, (256, 4), gamma=2.2) / 255.0) ** 2.2
    # Half a step of 255 at the steepest point of the response.
    assert np.abs(shown[0] - projector_profile(entry, (256, 4))).max() < 2.2 * 0.5 / 255


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: phase_shift_sequence(steps=2), "steps: found 2"),
        (lambda: phase_steps(2.0, 4), "period: found 2"),
        (lambda: phase_steps(4.0, 12, wave="square"), "at least 6 projector px for 12 steps"),
        (lambda: gray_sequence((99999, 10), cell_px=1.0), "found 17"),
        (lambda: gray_sequence(bits=5), "found 5; 11 tell"),
        (lambda: multi_frequency_sequence(periods_px=[100, 20]), "the longest is 100 of 1280"),
        (lambda: multi_frequency_sequence(ratio=1.0), "ratio"),
        (lambda: heterodyne_sequence(periods_px=[20, 22]), "beat of 220 px"),
        (lambda: heterodyne_sequence(periods_px=[20]), "two or three"),
        (lambda: heterodyne_sequence(count=4), "4 periods"),
        (lambda: heterodyne_sequence(period_px=900.0), "fit onto the projector"),
        (lambda: reference_sequence((1920, 1080)), "1280 of 1920"),
        (lambda: named_sequence("statistical", axes=("u", "v")), "one axis"),
        (lambda: named_sequence("statistical", count=1), "count"),
        (lambda: named_sequence("gray", steps=4), "options steps; expected some of axes, cell_px"),
        (lambda: with_exposures(reference_sequence(), [5, 5]), "exposures"),
        (lambda: with_exposures(reference_sequence(), [0]), "exposures"),
        (lambda: named_sequence("gray", (0, 5)), "projector"),
    ],
)  # fmt: skip
def test_what_a_projector_cannot_show_or_no_decoder_can_read_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
