"""Measurements of several parts in one run: each part a group, whatever they look like."""

from __future__ import annotations

import numpy as np
import pytest

import sheets
import synthetic
from planish.pipeline import register

#: 250 x 187 px.
SCALE = 0.18
#: A tenth of a pixel of 1.8 mm at the rim of the overlap.
PLACE_TOLERANCE_MM = 0.2
#: Part and place of each measurement: sheets of one shape, with grain of one kind, drawn anew for each.
MIXED = {
    "m1": (1, np.eye(4)), "m2": (2, sheets.T_TRUE), "m3": (1, sheets.T_TRUE), "m4": (3, sheets.T_TRUE),
    "m5": (2, np.eye(4)),
}  # fmt: skip


@pytest.fixture(scope="module")
def mixed():
    """Two measurements of each of two sheets, and one of a third."""
    found = [
        synthetic.measurement(
            T, sheets.grain(seed=part), name=name, scale=SCALE, bend=sheets.BENT, seed=int(name[1:])
        )
        for name, (part, T) in MIXED.items()
    ]  # fmt: skip
    return register(found, threads=2)


def test_two_parts_are_two_groups_and_what_is_of_another_part_stands_alone(mixed):
    groups = {}
    for m in mixed.measurements:
        groups.setdefault(m.group, set()).add(m.name)
    assert sorted(map(sorted, groups.values())) == [["m1", "m3"], ["m2", "m5"], ["m4"]]


def test_each_part_is_registered_rightly_and_what_keeps_the_others_apart_is_said(mixed):
    points = np.mgrid[-150:151:50, -100:101:50, 0:1].reshape(3, -1).T.astype(float)
    for pair in mixed.pairs:
        if MIXED[pair.a][0] == MIXED[pair.b][0]:
            T_true = np.linalg.inv(MIXED[pair.a][1]) @ MIXED[pair.b][1]
            assert sheets.errors_mm(pair.T_a_b, T_true, points).max() < PLACE_TOLERANCE_MM
        else:
            assert pair.status == "refused"
            assert pair.T_a_b is None
    # Every group but the largest is told by whom it came closest to another one.
    assert {group for a in mixed.network.advice for group in a.groups} == {0, 1, 2}
