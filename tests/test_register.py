"""The whole registration of a few small measurements: verdicts, groups, order, threads, bad input."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

import sheets
import synthetic
from planish.errors import InputError
from planish.geometry import difference, exp_se3, invert
from planish.pipeline import prepare_run, register
from planish.registration.pair import register_pair
from planish.registration.prepared import RefinementMaps
from planish.rig import Rig

#: 1.3 mm per pixel: a hundredth of a pixel along the surface, far less along the normal.
PLACE_TOLERANCE_MM = 0.05
#: Threads that wait longer for each other never meet.
WAIT_S = 60.0
PLACES = {"left": np.eye(4), "middle": sheets.T_TRUE, "right": sheets.T_TRUE @ exp_se3([0, 0.02, 0.4, 70, 30, 0])}


@pytest.fixture(scope="module")
def measurements():
    """Three measurements of one sheet, one of a plate without texture, and one without any point."""
    found = [sheets.noisy(sheets.quiet("a"), 1), sheets.noisy(sheets.quiet("b"), 2)]
    found.append(synthetic.measurement(PLACES["right"], sheets.grain(), scale=sheets.SCALE, bend=sheets.BENT, seed=3))
    found = [replace(m, name=name) for m, name in zip(found, PLACES, strict=True)]
    blank = replace(sheets.noisy(sheets.quiet("a", 0.0, 0.0), 4), name="blank")
    nothing = replace(blank, name="nothing", points_sensor=np.full_like(blank.points_sensor, np.nan))
    return [*found, blank, nothing]


@pytest.fixture(scope="module")
def registration(measurements):
    return register(measurements, threads=2)


def test_measurements_of_one_part_are_placed_rightly(registration):
    assert [m.name for m in registration.measurements if m.group == 0] == ["left", "middle", "right"]
    reference = registration.groups[0].reference
    points = np.mgrid[-150:151:50, -100:101:50, 0:1].reshape(3, -1).T.astype(float)
    for placed in registration.measurements:
        if placed.group == 0:
            T_true = invert(PLACES[reference]) @ PLACES[placed.name]
            assert sheets.errors_mm(placed.T_world_measurement, T_true, points).max() < PLACE_TOLERANCE_MM


def test_maps_for_the_refinement_are_made_once_and_only_where_a_pair_is_accepted(measurements):
    options, prepared = prepare_run(measurements, threads=2)
    made = []

    def watched(name):
        item = prepared[name]
        return replace(item, refinement=RefinementMaps(lambda: made.append(name) or item.refinement.get()))

    left, middle, blank = (watched(name) for name in ("left", "middle", "blank"))
    assert register_pair(left, blank, options).status == "refused"
    assert made == []
    assert register_pair(left, middle, options).status == "accepted"
    assert register_pair(middle, left, options).status == "accepted"
    assert sorted(made) == ["left", "middle"]


def test_maps_that_another_thread_is_making_are_not_waited_for_at_first():
    made, begun, go_on = [], threading.Event(), threading.Event()

    def make():
        made.append(threading.get_ident())
        begun.set()
        assert go_on.wait(WAIT_S)
        return {}, {}

    maps = RefinementMaps(make)
    other = threading.Thread(target=maps.begin)
    other.start()
    assert begun.wait(WAIT_S)
    maps.begin()
    go_on.set()
    assert maps.get() == ({}, {})
    other.join(WAIT_S)
    maps.begin()
    assert made == [other.ident]


def test_what_shows_no_texture_or_no_surface_stays_alone_with_a_reason(registration):
    for name in ("blank", "nothing"):
        pairs = [p for p in registration.pairs if name in (p.a, p.b)]
        assert len(pairs) == 4
        assert all(p.status == "refused" and p.reason and p.T_a_b is None for p in pairs)
    assert len(registration.groups) == 3


def test_neither_order_nor_threads_change_a_byte(measurements, registration, tmp_path):
    contents = set()
    registration.save(tmp_path / "registration.json")
    contents.add((tmp_path / "registration.json").read_bytes())
    for threads, order in ((1, [2, 0, 4, 1, 3]), (8, [4, 3, 2, 1, 0])):
        register([measurements[i] for i in order], threads=threads).save(tmp_path / "other.json")
        contents.add((tmp_path / "other.json").read_bytes())
    assert len(contents) == 1


def test_a_single_measurement_is_its_own_world(measurements):
    found = register(measurements[:1])
    assert found.groups[0].reference == "left"
    assert found.pairs == ()
    np.testing.assert_array_equal(found.measurements[0].T_world_measurement, np.eye(4))


def test_the_reference_can_be_chosen(measurements):
    assert register(measurements[:2], reference="middle").groups[0].reference == "middle"


def test_bad_input_is_named(measurements):
    with pytest.raises(InputError, match="found none"):
        register([])
    with pytest.raises(InputError, match="'left' stands 2 times"):
        register([measurements[0], measurements[0]])
    with pytest.raises(InputError, match=r"reference.*'other'.*left"):
        register(measurements[:2], reference="other")
    with pytest.raises(InputError, match="threads"):
        register(measurements[:1], threads=0)


def test_progress_is_told_stage_by_stage(measurements):
    said = []
    register(measurements[:2], progress=lambda *step: said.append(step))
    assert {stage for stage, *_ in said} == {"texture", "pairs", "overlap"}
    assert all(0 <= done <= total for _, done, total in said)


def shrunk(m, factor):
    """The same measurement of a part and sensor that are `factor` times as large."""
    cameras = {}
    for name, item in m.rig.cameras.items():
        T = item.T_camera_sensor.copy()
        T[:3, 3] *= factor
        cameras[name] = replace(item, T_camera_sensor=T)
    return replace(m, rig=Rig(cameras), points_sensor=m.points_sensor * np.float32(factor),
                   sigma_mm=m.sigma_mm * np.float32(factor))  # fmt: skip


@pytest.mark.parametrize("factor", [0.1, 8.0])
def test_a_small_and_a_large_sensor_register_like_the_reference(factor):
    a, b = (sheets.noisy(sheets.quiet(side), seed) for side, seed in (("a", 1), ("b", 2)))
    pair = register([shrunk(a, factor), shrunk(b, factor)]).pair("a", "b")
    assert pair.status == "accepted", pair.reason
    expected = sheets.T_TRUE.copy()
    expected[:3, 3] *= factor
    error = difference(expected, pair.T_a_b, pair.covariance_point_mm)
    # A twentieth of a pixel of 1.3 mm, scaled.
    assert np.linalg.norm(error[3:]) < 0.05 * sheets.GSD_MM * factor


def test_measurements_of_different_resolution_register():
    fine = synthetic.measurement(np.eye(4), sheets.grain(), name="a", scale=2 * sheets.SCALE, bend=sheets.BENT, seed=5)
    coarse = sheets.noisy(sheets.quiet("b"), 2)
    pair = register([fine, coarse], threads=2).pair("a", "b")
    assert pair.status == "accepted", pair.reason
    error = difference(sheets.T_TRUE, pair.T_a_b, pair.covariance_point_mm)
    assert np.linalg.norm(error[3:]) < PLACE_TOLERANCE_MM
