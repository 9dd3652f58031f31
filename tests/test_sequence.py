"""What a sequence must hold, and how it is refused."""

import pytest

from planish.errors import InputError
from planish.sensing.sequence import read_layout
from sequences import gray_entries, manifest, phase_entries


def test_periods_stand_from_the_longest_to_the_shortest_with_steps_in_order():
    entries = phase_entries([20, 1280, 160])
    entries.reverse()
    layout = read_layout(manifest(entries, projector_px=(1280, 800)), "m")
    assert [p.period_px for p in layout.periods] == [1280, 160, 20]
    assert layout.periods[0].images == (7, 6, 5, 4)
    assert layout.extent_px == 1280


def test_gray_bits_stand_from_the_most_significant_on_with_their_inverse():
    layout = read_layout(manifest(phase_entries([20]) + gray_entries(3, 10, inverse=True)), "m")
    assert layout.gray.images == (4, 6, 8)
    assert layout.gray.inverse == (5, 7, 9)


def test_fringes_along_v_are_used_where_there_are_none_along_u():
    entries = [entry | {"axis": "v"} for entry in phase_entries([800, 100])]
    layout = read_layout(manifest(entries, projector_px=(1280, 800)), "m")
    assert (layout.axis, layout.extent_px) == ("v", 800)


@pytest.mark.parametrize(
    ("sequence", "message"),
    [
        ([{"role": "white"}, *gray_entries(4, 10)], "no phase images"),
        (phase_entries([1280])[:3], r"steps \[0, 1, 2\] of 4"),
        (phase_entries([1280]) + phase_entries([1280])[:1], r"steps \[0, 0, 1, 2, 3\] of 4"),
        (phase_entries([160, 20]), "longest period is 160 of 1280"),
        (phase_entries([20]) + gray_entries(4, 10)[1:3] + gray_entries(4, 10)[:1], r"Gray bits \[1, 2, 3\]"),
        (phase_entries([20]) + gray_entries(3, 40), "longer than the longest period"),
    ],
)
def test_a_sequence_with_gaps_is_refused(sequence, message):
    with pytest.raises(InputError, match=message):
        read_layout(manifest(sequence, projector_px=(1280, 800)), "m")
