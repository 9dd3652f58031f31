"""What a sequence must hold, and how it is refused."""

import pytest

from planish.errors import InputError
from planish.sensing.capture.sequence import read_layouts
from sequences import gray_entries, manifest, phase_entries


def test_periods_stand_from_the_longest_to_the_shortest_with_steps_in_order():
    entries = phase_entries([20, 1280, 160])
    entries.reverse()
    (layout,) = read_layouts(manifest(entries, projector_px=(1280, 800)), "m")
    (code,) = layout.codes
    assert [p.period_px for p in code.periods] == [1280, 160, 20]
    assert code.periods[0].images == (7, 6, 5, 4)
    assert code.extent_px == 1280


def test_gray_bits_stand_from_the_most_significant_on_with_their_inverse():
    (layout,) = read_layouts(manifest(phase_entries([20]) + gray_entries(3, 10, inverse=True)), "m")
    assert layout.codes[0].gray.images == (4, 6, 8)
    assert layout.codes[0].gray.inverse == (5, 7, 9)


def test_each_axis_has_its_own_code_with_its_own_extent():
    along_v = [entry | {"axis": "v"} for entry in phase_entries([800, 100])]
    (layout,) = read_layouts(manifest(along_v + phase_entries([1280, 40]), projector_px=(1280, 800)), "m")
    assert [(code.axis, code.extent_px) for code in layout.codes] == [("u", 1280), ("v", 800)]
    assert layout.codes[0].phase_images == tuple(range(8, 16))


def test_exposures_are_parted_and_stand_from_the_longest_to_the_shortest():
    entries = [entry | {"exposure_ms": ms} for ms in (5.0, 20.0) for entry in phase_entries([1280])]
    layouts = read_layouts(manifest(entries, projector_px=(1280, 800)), "m")
    found = [(layout.exposure_ms, layout.phase_images) for layout in layouts]
    assert found == [(20.0, (4, 5, 6, 7)), (5.0, (0, 1, 2, 3))]


def test_statistical_patterns_need_no_code():
    (layout,) = read_layouts(manifest([{"role": "statistical", "index": k} for k in range(10)]), "m")
    assert (layout.codes, layout.statistical) == ((), tuple(range(10)))


@pytest.mark.parametrize(
    ("sequence", "message"),
    [
        ([{"role": "white"}, {"role": "black"}], "nothing that encodes a position"),
        (phase_entries([1280]) + [{"role": "statistical", "index": 0}], "statistical patterns and fringes"),
        (phase_entries([1280]) + [{"role": "white", "exposure_ms": 3.0}], "some entries have an exposure_ms"),
        (phase_entries([1280])[:3], r"steps \[0, 1, 2\] of 4"),
        (phase_entries([1280]) + phase_entries([1280])[:1], r"steps \[0, 0, 1, 2, 3\] of 4"),
        (phase_entries([160, 20]), "longest period is 160 of 1280"),
        (phase_entries([20]) + gray_entries(4, 10)[1:3] + gray_entries(4, 10)[:1], r"Gray bits \[1, 2, 3\]"),
        (phase_entries([20]) + gray_entries(3, 40), "longer than the longest period"),
    ],
)
def test_a_sequence_with_gaps_is_refused(sequence, message):
    with pytest.raises(InputError, match=message):
        read_layouts(manifest(sequence, projector_px=(1280, 800)), "m")
